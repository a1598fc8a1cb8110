"""What can go wrong in the world: each fault is its own type and never a reward."""


class Fault(RuntimeError):
    """The world cannot go on; the episode has no outcome."""


class PhysicsDiverged(Fault):
    """Positions or velocities became non-finite or impossibly large."""


class RendererUnavailable(Fault):
    """No OpenGL context could be made."""


class InvalidAction(Fault):
    """The action has the wrong shape, is not finite, or comes when no step is allowed."""


class InvalidReset(Fault):
    """What is asked for is not there: a task, a layout, a seed, a free layout."""
