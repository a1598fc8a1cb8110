"""Types and checks of single values, shared by all messages."""

import math
import re
from collections.abc import Sized
from typing import Annotated

from rever_env.protocol import limits
from rever_env.protocol.codec import Bits
from rever_env.protocol.keys import PROTOCOL_VERSION

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
U32 = Annotated[int, Bits(32)]


class Numbered:
    """A message with a sequence number in its session, from 1."""

    sequence: int

    def validate(self) -> None:
        """Raises a ValueError that names the field, the expected and the actual value."""
        sequence(self.sequence, 1)


def name(field: str, value: str) -> None:
    """A name: not empty, not too long, without control characters."""
    count = len(value.encode())
    if not 1 <= count <= limits.NAME_BYTES_MAX:
        raise ValueError(f"{field}: expected 1 to {limits.NAME_BYTES_MAX} bytes, got {count}")
    found = _CONTROL.search(value)
    if found:
        raise ValueError(f"{field}: expected no control characters, got U+{ord(found[0]):04X}")


def printable(text: str) -> str:
    """A peer's text without control characters, for a terminal or a log."""
    return _CONTROL.sub("\N{REPLACEMENT CHARACTER}", text)


def text(field: str, value: str) -> None:
    """A text: not too long."""
    count = len(value.encode())
    if count > limits.TEXT_BYTES_MAX:
        raise ValueError(f"{field}: expected at most {limits.TEXT_BYTES_MAX} bytes, got {count}")


def elements(field: str, length: int) -> None:
    """A list of limited length."""
    if length > limits.ELEMENTS_MAX:
        raise ValueError(f"{field}: expected at most {limits.ELEMENTS_MAX} elements, got {length}")


def length(field: str, values: Sized, low: int, high: int) -> None:
    """A list with low to high numbers."""
    if not low <= len(values) <= high:
        raise ValueError(f"{field}: expected {low} to {high} numbers, got {len(values)}")


def finite(field: str, values: tuple[float, ...]) -> None:
    """Numbers that are finite as 32-bit floats."""
    for index, number in enumerate(values):
        if not math.isfinite(number):
            raise ValueError(f"{field}: expected finite numbers, got {number} at index {index}")
        if abs(number) > limits.FLOAT_MAX:
            raise ValueError(f"{field}: expected 32-bit numbers, got {number} at index {index}")


def positive(field: str, value: float) -> None:
    """A positive number."""
    finite(field, (value,))
    if value <= 0.0:
        raise ValueError(f"{field}: expected a number above 0, got {value:g}")


def range(field: str, value: int, low: int, high: int) -> None:
    """A whole number from low to high, inclusive."""
    if not low <= value <= high:
        raise ValueError(f"{field}: expected {low} to {high}, got {value}")


def image_sides(fields: tuple[str, str], height: int, width: int) -> None:
    """An image size; both sides are 0 for no image."""
    if (height, width) != (0, 0):
        range(fields[0], height, 1, limits.IMAGE_SIDE_MAX)
        range(fields[1], width, 1, limits.IMAGE_SIDE_MAX)


def sequence(value: int, low: int) -> None:
    """A sequence number; 0 is valid only in a reply to a request that could not be read."""
    range("sequence", value, low, limits.SEED_END - 1)


def protocol(version: int) -> None:
    """The protocol version of a peer, which must be this one."""
    if version != PROTOCOL_VERSION:
        raise ValueError(f"expected protocol {PROTOCOL_VERSION}, got protocol {version}")


def recognise_protocol(content: object) -> None:
    """The protocol version of a peer, possibly another one with other fields."""
    version = content.get("protocol") if isinstance(content, dict) else None
    if type(version) is int:
        protocol(version)
