"""What a server says about itself."""

from dataclasses import dataclass

from rever_env.protocol import limits, value
from rever_env.protocol.value import U32


@dataclass(frozen=True)
class TaskDescription:
    """One task in one variant. configurations: how many fixed ones there are."""

    task: str
    variant: str
    version: U32
    instruction: str
    steps_max: U32
    configurations: U32


@dataclass(frozen=True)
class Description:
    """The answer to a query on describe."""

    protocol: U32
    server: str
    simulator: str
    simulator_version: str
    tasks: tuple[TaskDescription, ...]
    state: tuple[str, ...]
    action: tuple[str, ...]
    image_side_max: U32
    sessions: U32
    sessions_max: U32
    slots_max: U32
    idle_secs_max: U32

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
        value.range("state", len(self.state), limits.STATE_LENGTH, limits.STATE_LENGTH)
        value.range("action", len(self.action), limits.ACTION_LENGTH, limits.ACTION_LENGTH)
        for name in self.state + self.action:
            value.name("value name", name)
        value.range("image_side_max", self.image_side_max, 1, limits.IMAGE_SIDE_MAX)
        value.range("sessions_max", self.sessions_max, 1, limits.SESSIONS_MAX)
        value.range("sessions", self.sessions, 0, self.sessions_max)
        value.range("slots_max", self.slots_max, 0, limits.SLOTS_MAX)
        value.range("idle_secs_max", self.idle_secs_max, 1, 1_000_000)
