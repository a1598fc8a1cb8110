"""Requests of the holder of a session, one at a time, numbered from 1.

A repeated number gets the same reply again, a lower one gets no reply, a gap is refused.
"""

from dataclasses import dataclass

from rever_env.protocol import limits, value
from rever_env.protocol.value import U32, Numbered


@dataclass(frozen=True)
class Reset(Numbered):
    """Starts an episode and ends the previous one.

    layout: a fixed initial layout; None draws a random one from the seed, 0 to 2^53 - 1.
    """

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
    """One control step. action: the numbers that TaskDescription.action describes.

    Bridge tasks: dx dy dz (m), rotation vector (rad), gripper (+1 open, -1 closed).
    """

    sequence: int
    action: tuple[float, ...]

    def validate(self) -> None:
        super().validate()
        value.length("action", self.action, 1, limits.ACTION_DIMENSIONS_MAX)
        value.finite("action", self.action)


@dataclass(frozen=True)
class Save(Numbered):
    """Saves the state in a slot until the next Reset."""

    sequence: int
    slot: U32

    def validate(self) -> None:
        super().validate()
        value.range("slot", self.slot, 0, limits.SLOTS_MAX - 1)


@dataclass(frozen=True)
class Restore(Numbered):
    """Restores the state in a slot, bit-exact."""

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
