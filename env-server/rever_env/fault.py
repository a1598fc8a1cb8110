"""Faults of an environment: the episode has no outcome. A fault is never a reward."""


class Fault(RuntimeError):
    """The environment cannot continue; the episode has no outcome."""


class PhysicsDiverged(Fault):
    """Positions or velocities became non-finite or impossibly large."""


class RendererUnavailable(Fault):
    """No OpenGL context could be created."""


class InvalidAction(Fault):
    """The action has the wrong shape or is not finite, or no step is allowed at this moment."""


class InvalidReset(Fault):
    """An unknown task, variant or layout, an invalid seed, or no free random layout."""
