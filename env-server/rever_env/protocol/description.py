"""A server's description: its simulator, tasks and limits."""

from dataclasses import dataclass

from rever_env.protocol import limits, value
from rever_env.protocol.value import U32


@dataclass(frozen=True)
class Dimension:
    """One number of a state or an action: name, unit and optional bounds.

    discrete: only whole numbers from low to high are valid.
    """

    name: str
    low: float | None
    high: float | None
    discrete: bool

    def validate(self) -> None:
        value.name("dimension", self.name)
        field = f"dimension {self.name}"
        bounds = tuple(bound for bound in (self.low, self.high) if bound is not None)
        value.finite(field, bounds)
        is_whole = len(bounds) == 2 and all(bound.is_integer() for bound in bounds)
        if self.discrete and not is_whole:
            raise ValueError(f"{field}: expected whole bounds, for it is discrete")
        if len(bounds) == 2 and bounds[0] > bounds[1]:
            raise ValueError(f"{field}: expected low <= high, got {bounds[0]:g} and {bounds[1]:g}")


@dataclass(frozen=True)
class TaskDescription:
    """One task in one variant.

    steps_max: episodes are truncated after so many steps. control_hz: control steps per second of
    simulated time, if it is known. layouts: the number of fixed initial layouts.
    """

    task: str
    variant: str
    version: U32
    instruction: str
    steps_max: U32
    control_hz: float | None
    layouts: U32
    state: tuple[Dimension, ...]
    action: tuple[Dimension, ...]


@dataclass(frozen=True)
class Description:
    """The answer to a query on the key describe."""

    protocol: U32
    server: str
    simulator: str
    simulator_version: str
    tasks: tuple[TaskDescription, ...]
    image_side_max: U32
    sessions: U32
    sessions_max: U32
    slots_max: U32

    def validate(self) -> None:
        value.protocol(self.protocol)
        value.name("server", self.server)
        value.name("simulator", self.simulator)
        value.name("simulator_version", self.simulator_version)
        value.elements("tasks", len(self.tasks))
        for task in self.tasks:
            value.name("task", task.task)
            value.name("variant", task.variant)
            value.text("instruction", task.instruction)
            value.range("steps_max", task.steps_max, 1, 1_000_000)
            if task.control_hz is not None:
                value.positive("control_hz", task.control_hz)
            value.length("state", task.state, 0, limits.STATE_DIMENSIONS_MAX)
            value.length("action", task.action, 1, limits.ACTION_DIMENSIONS_MAX)
            for dimension in task.state + task.action:
                dimension.validate()
        value.range("image_side_max", self.image_side_max, 0, limits.IMAGE_SIDE_MAX)
        value.range("sessions_max", self.sessions_max, 1, limits.SESSIONS_MAX)
        value.range("sessions", self.sessions, 0, self.sessions_max)
        value.range("slots_max", self.slots_max, 0, limits.SLOTS_MAX)
