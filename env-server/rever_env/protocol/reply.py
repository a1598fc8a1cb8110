"""What a server answers, echoing the request's number."""

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
    """What broke in the world."""

    PHYSICS_DIVERGED = "PhysicsDiverged"
    RENDERER_UNAVAILABLE = "RendererUnavailable"
    INTERNAL = "Internal"


@dataclass(frozen=True)
class Observed(Numbered):
    """To Reset."""

    sequence: int
    observation: Observation

    def validate(self) -> None:
        super().validate()
        self.observation.validate()


@dataclass(frozen=True)
class Stepped(Numbered):
    """To Step. simulator_us: microseconds of physics, picture and judge, without the wire.

    changed_tiles: None, or the image's pixels are those of these tiles only (tiles.complete).
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
    """To Save."""

    sequence: int


@dataclass(frozen=True)
class Restored(Numbered):
    """To Restore."""

    sequence: int
    observation: Observation

    def validate(self) -> None:
        super().validate()
        self.observation.validate()


@dataclass(frozen=True)
class Closed(Numbered):
    """To Close."""

    sequence: int


@dataclass(frozen=True)
class Refused:
    """The request was wrong; the world is unchanged. 0: its number is unknown or is no more."""

    sequence: int
    reason: str

    def validate(self) -> None:
        value.sequence(self.sequence, 0)
        value.text("reason", self.reason)


@dataclass(frozen=True)
class Faulted(Numbered):
    """The world broke: the episode is void, and only Reset or Close can follow."""

    sequence: int
    kind: FaultKind
    reason: str

    def validate(self) -> None:
        super().validate()
        value.text("reason", self.reason)


Reply = Observed | Stepped | Saved | Restored | Closed | Refused | Faulted
