"""Parts of Gymnasium spaces: numbers, described as in the protocol, images and texts."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rever_env.protocol import Dimension


@dataclass(frozen=True)
class Part:
    """A space without parts in an observation space. keys: its path from the outermost one."""

    keys: tuple[Any, ...]
    space: spaces.Space[Any]

    @property
    def name(self) -> str:
        """The keys, joined by dots; empty for the whole observation."""
        return ".".join(str(key) for key in self.keys)

    @property
    def is_image(self) -> bool:
        return is_image(self.space)

    @property
    def is_text(self) -> bool:
        return isinstance(self.space, spaces.Text)

    def is_within(self, name: str) -> bool:
        """Whether the part has this name or is inside the one with this name."""
        return self.name == name or self.name.startswith(f"{name}.")

    def of(self, observation: Any) -> Any:
        """The value of the part in an observation."""
        for key in self.keys:
            observation = observation[key]
        return observation

    def dimensions(self, name: str) -> tuple[Dimension, ...]:
        """The dimensions of a numeric part. name: the name of the observation."""
        return dimensions_of(self.space, f"{name}.{self.name}" if self.keys else name)

    def numbers(self, observation: Any) -> list[float]:
        """The numbers of a numeric part, in the order of its dimensions."""
        return numbers_of(self.space, self.of(observation))


def parts_of(space: spaces.Space[Any], keys: tuple[Any, ...] = ()) -> list[Part]:
    """All parts of an observation space, in its order."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        return [part for key, inner in _parts(space) for part in parts_of(inner, (*keys, key))]
    return [Part(keys, space)]


def is_image(space: spaces.Space[Any]) -> bool:
    """Whether it is an RGB image: uint8 (rows, columns, 3)."""
    return (
        isinstance(space, spaces.Box)
        and space.dtype == np.uint8
        and len(space.shape) == 3
        and space.shape[2] == 3
    )


def dimensions_of(space: spaces.Space[Any], name: str) -> tuple[Dimension, ...]:
    """The numbers of a value of the space; ValueError if their count is not fixed.

    Images and texts have none. name: the name of the space; its parts are name.part or name[index].
    """
    if is_image(space) or isinstance(space, spaces.Text):
        return ()
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        return tuple(
            dimension
            for part, inner in _parts(space)
            for dimension in dimensions_of(inner, f"{name}.{part}")
        )
    if isinstance(space, spaces.Discrete):
        start = float(space.start)
        return (Dimension(name, start, start + float(space.n) - 1.0, True),)
    if isinstance(space, spaces.Box):
        low, high = space.low, space.high
    elif isinstance(space, spaces.MultiDiscrete):
        low = np.asarray(space.start)
        high = low + np.asarray(space.nvec) - 1
    elif isinstance(space, spaces.MultiBinary):
        low, high = np.zeros(space.shape), np.ones(space.shape)
    else:
        raise ValueError(
            f"space {name}: expected Box, Discrete, MultiDiscrete, MultiBinary, Text, or a Dict or "
            f"Tuple of them, got {type(space).__name__}"
        )
    is_discrete = np.issubdtype(space.dtype, np.integer)
    dimensions = []
    for index in np.ndindex(low.shape):
        place = "".join(f"[{number}]" for number in index)
        bounds = (_bound(low[index]), _bound(high[index]))
        discrete = bool(is_discrete) and None not in bounds
        dimensions.append(Dimension(f"{name}{place}", *bounds, discrete))
    return tuple(dimensions)


def numbers_of(space: spaces.Space[Any], value: Any) -> list[float]:
    """The numbers of a value, in the order of dimensions_of."""
    if is_image(space) or isinstance(space, spaces.Text):
        return []
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        return [
            number for part, inner in _parts(space) for number in numbers_of(inner, value[part])
        ]
    numbers: list[float] = np.asarray(value, np.float64).reshape(-1).tolist()
    return numbers


def value_of(space: spaces.Space[Any], numbers: NDArray[np.float64]) -> Any:
    """The value of an action space from its numbers: the inverse of numbers_of."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        values, start = {}, 0
        for part, inner in _parts(space):
            count = len(dimensions_of(inner, ""))
            values[part] = value_of(inner, numbers[start : start + count])
            start += count
        return values if isinstance(space, spaces.Dict) else tuple(values.values())
    if isinstance(space, spaces.Discrete):
        return space.dtype.type(numbers[0])
    return numbers.reshape(space.shape or ()).astype(space.dtype)


def _parts(space: "spaces.Dict | spaces.Tuple[Any]") -> list[tuple[Any, spaces.Space[Any]]]:
    if isinstance(space, spaces.Dict):
        return list(space.spaces.items())
    return list(enumerate(space.spaces))


def _bound(value: Any) -> float | None:
    """The bound, or None: integer types mark a missing bound by their largest number."""
    number = float(np.float32(value))
    return number if abs(number) < float(np.finfo(np.float32).max) else None
