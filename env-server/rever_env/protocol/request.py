"""What the holder of a session asks, one at a time.

The same number again is answered with the same bytes again, a lower one with silence, a gap is
refused.
"""

from dataclasses import dataclass

from rever_env.protocol import limits, value
from rever_env.protocol.value import U32, Numbered


@dataclass(frozen=True)
class Reset(Numbered):
    """Starts an episode; ends the one before. layout None draws from the seed."""

    sequence: int
    task: str
    variant: str
    layout: U32 | None
    seed: int

    def validate(self) -> None:
        super().validate()
        value.name("task", self.task)
        value.name("variant", self.variant)
        value.range("seed", self.seed, 0, limits.SEED_END - 1)


@dataclass(frozen=True)
class Step(Numbered):
    """One control step. In a Bridge task: metres, rotation vector (rad), gripper +1 open."""

    sequence: int
    action: tuple[float, ...]

    def validate(self) -> None:
        super().validate()
        value.length("action", self.action, 1, limits.ACTION_DIMENSIONS_MAX)
        value.finite("action", self.action)


@dataclass(frozen=True)
class Save(Numbered):
    """Keeps the state in a slot until the next Reset."""

    sequence: int
    slot: U32

    def validate(self) -> None:
        super().validate()
        value.range("slot", self.slot, 0, limits.SLOTS_MAX - 1)


@dataclass(frozen=True)
class Restore(Numbered):
    """Goes back to the state in a slot, bit by bit."""

    sequence: int
    slot: U32

    def validate(self) -> None:
        super().validate()
        value.range("slot", self.slot, 0, limits.SLOTS_MAX - 1)


@dataclass(frozen=True)
class Close(Numbered):
    """Ends the session."""

    sequence: int


Request = Reset | Step | Save | Restore | Close
