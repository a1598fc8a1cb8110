"""Instruction: one space for the instructions of all tasks, readable from shared memory."""

import string
from collections.abc import Sequence
from ctypes import c_uint8
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import (
    create_shared_memory,
    read_from_shared_memory,
    write_to_shared_memory,
)
from numpy.typing import NDArray

from rever_env.protocol import limits

_PRINTABLE = string.ascii_letters + string.digits + string.punctuation + " "


class Instruction(spaces.Text):
    """Any text within the protocol's limit; samples are printable ASCII.

    gymnasium.spaces.Text has a fixed set of characters, so that two tasks would have different
    spaces; and AsyncVectorEnv reads it from shared memory only once, before the first reset, so
    that every instruction would be blank. This space is equal for all tasks and read at each step.
    """

    def __init__(self, seed: int | np.random.Generator | None = None) -> None:
        super().__init__(limits.TEXT_BYTES_MAX, min_length=0, charset=_PRINTABLE, seed=seed)

    def contains(self, x: Any) -> bool:
        """Whether x is a text, in any language, within the protocol's limit."""
        return isinstance(x, str) and len(_encoded(x)) <= limits.TEXT_BYTES_MAX

    def __repr__(self) -> str:
        return f"Instruction(up to {limits.TEXT_BYTES_MAX} bytes of text)"


class _SharedTexts(Sequence[str]):
    """A view of the instructions in shared memory; a copy keeps the present ones."""

    def __init__(self, rows: NDArray[np.uint8]) -> None:
        self._rows = rows  # (environments, bytes), each text padded with zeros

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return tuple(self)[index]
        return self._rows[index].tobytes().rstrip(b"\0").decode("utf-8", "surrogatepass")

    def __deepcopy__(self, _memo: dict[int, Any]) -> tuple[str, ...]:
        return tuple(self)


@create_shared_memory.register(Instruction)
def _create(_space: Instruction, n: int = 1, ctx: Any = None) -> Any:
    return ctx.Array(c_uint8, n * limits.TEXT_BYTES_MAX)


@read_from_shared_memory.register(Instruction)
def _read(_space: Instruction, shared_memory: Any, n: int = 1) -> Any:
    return _SharedTexts(_rows(shared_memory).reshape(n, limits.TEXT_BYTES_MAX))


@write_to_shared_memory.register(Instruction)
def _write(_space: Instruction, index: int, value: str, shared_memory: Any) -> None:
    row = _rows(shared_memory).reshape(-1, limits.TEXT_BYTES_MAX)[index]
    data = _encoded(value)
    row[: len(data)] = np.frombuffer(data, np.uint8)
    row[len(data) :] = 0


def _rows(shared_memory: Any) -> NDArray[np.uint8]:
    return np.frombuffer(shared_memory.get_obj(), np.uint8)


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")
