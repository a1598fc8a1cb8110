"""What the holder of a session asks, one at a time.

The same number again is answered with the same bytes again, a lower one with silence, a gap is
refused.
"""

import math
import struct
from dataclasses import dataclass
from typing import NamedTuple

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


class _StepLayout(NamedTuple):
    """Where a Step's numbers lie in its bytes, and what lies around them."""

    pattern: struct.Struct
    texts: tuple[bytes, bytes]  # before and behind the sequence
    sequences: range
    markers: tuple[int, ...]  # before each number of the action


def _step_layouts() -> dict[int, _StepLayout]:
    """How a Step of up to 15 numbers is written, by the count of its bytes, which no two share."""
    layouts = {}
    integers = (
        (b"", "B", 1, 0x80),
        (b"\xcc", "B", 0x80, 0x100),
        (b"\xcd", "H", 0x100, 0x1_0000),
        (b"\xce", "I", 0x1_0000, 0x1_0000_0000),
    )
    for count in range(1, 16):
        for marker, form, first, end in integers:
            texts = b"\x81\xa4Step\x82\xa8sequence" + marker, b"\xa6action" + bytes([0x90 | count])
            floats = "Bf" * count
            pattern = struct.Struct(f">{len(texts[0])}s{form}{len(texts[1])}s{floats}")
            layouts[pattern.size] = _StepLayout(pattern, texts, range(first, end), (0xCA,) * count)
    return layouts


_STEP_LAYOUTS = _step_layouts()


def step_in_layout(data: bytes) -> Step | None:
    """A valid Step, written as encode writes it; None for all else, and for very long ones.

    Nearly all requests are one, and right after a control step nothing of Python's is in the
    processor's caches: this touches little of it.
    """
    layout = _STEP_LAYOUTS.get(len(data))
    if layout is None:
        return None
    pattern, texts, sequences, markers = layout
    values = pattern.unpack(data)  # text, sequence, text, and a marker before each number
    sequence, action = values[1], values[4::2]
    if (
        values[0:3:2] != texts
        or values[3::2] != markers
        or sequence not in sequences
        or not all(map(math.isfinite, action))
    ):
        return None
    return Step(sequence, action)
