"""Replies of a server; each repeats the sequence number of its request."""

import enum
from dataclasses import dataclass

from rever_env.protocol import tiles, value
from rever_env.protocol.observation import Observation
from rever_env.protocol.statistics import Statistics
from rever_env.protocol.value import U32, Numbered


@dataclass(frozen=True)
class Transition:
    """The result of one control step."""

    observation: Observation
    statistics: Statistics
    reward: float
    terminated: bool
    truncated: bool


class FaultKind(str, enum.Enum):
    """The kind of a fault."""

    PHYSICS_DIVERGED = "PhysicsDiverged"
    RENDERER_UNAVAILABLE = "RendererUnavailable"
    INTERNAL = "Internal"


@dataclass(frozen=True)
class Observed(Numbered):
    """Reply to Reset."""

    sequence: int
    observation: Observation

    def validate(self) -> None:
        super().validate()
        self.observation.validate()


@dataclass(frozen=True)
class Stepped(Numbered):
    """Reply to Step.

    simulator_us: microseconds of physics, rendering and success rules, without the network.
    changed_tiles: None for a whole image; otherwise the pixels are those of these tiles only, which
    tiles.complete adds to the last image.
    """

    sequence: int
    transition: Transition
    changed_tiles: tuple[U32, ...] | None
    simulator_us: U32

    def validate(self) -> None:
        super().validate()
        observation = self.transition.observation
        if self.changed_tiles is None:
            observation.image.validate()
        else:
            tiles.validate(observation.image, self.changed_tiles)
        observation.validate_rest()
        value.finite("reward", (self.transition.reward,))


@dataclass(frozen=True)
class Saved(Numbered):
    """Reply to Save."""

    sequence: int


@dataclass(frozen=True)
class Restored(Numbered):
    """Reply to Restore."""

    sequence: int
    observation: Observation

    def validate(self) -> None:
        super().validate()
        self.observation.validate()


@dataclass(frozen=True)
class Closed(Numbered):
    """Reply to Close."""

    sequence: int


@dataclass(frozen=True)
class Refused:
    """The request was invalid; the environment is unchanged.

    sequence 0: the request could not be read, or the session has ended.
    """

    sequence: int
    reason: str

    def validate(self) -> None:
        value.sequence(self.sequence, 0)
        value.text("reason", self.reason)


@dataclass(frozen=True)
class Faulted(Numbered):
    """The environment broke: the episode has no outcome; only Reset or Close may follow."""

    sequence: int
    kind: FaultKind
    reason: str

    def validate(self) -> None:
        super().validate()
        value.text("reason", self.reason)


Reply = Observed | Stepped | Saved | Restored | Closed | Refused | Faulted
