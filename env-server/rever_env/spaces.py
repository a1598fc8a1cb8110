"""Gymnasium's spaces and the protocol's dimensions: one of them made from the other."""

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rever_env.protocol import Dimension

RANDOM_SEEDS = 1_000_000_000  # seeds drawn by reset(seed=None) lie below this


def observation_space(
    height: int, width: int, instruction: str, state: Sequence[Dimension]
) -> spaces.Dict:
    """image uint8 (height, width, 3), state float32 (as many as described,), instruction text.

    Without pixels there is no image, and without numbers no state.
    """
    fields: dict[str, spaces.Space[Any]] = {}
    if height and width:
        fields["image"] = spaces.Box(0, 255, (height, width, 3), np.uint8)
    if state:
        fields["state"] = box(state)
    fields["instruction"] = spaces.Text(
        max_length=max(len(instruction), 1), charset="".join(sorted(set(instruction))) or " "
    )
    return spaces.Dict(fields)


def action_space(
    dimensions: Sequence[Dimension],
) -> spaces.Box | spaces.Discrete | spaces.MultiDiscrete:
    """Discrete for one discrete number, MultiDiscrete for several; otherwise Box, float32."""
    if not all(dimension.discrete for dimension in dimensions):
        return box(dimensions)
    starts = [int(dimension.low or 0) for dimension in dimensions]
    counts = [
        int(dimension.high or 0) - start + 1
        for dimension, start in zip(dimensions, starts, strict=True)
    ]
    if len(dimensions) == 1:
        return spaces.Discrete(counts[0], start=starts[0])
    return spaces.MultiDiscrete(counts, start=starts)


def box(dimensions: Sequence[Dimension]) -> spaces.Box:
    """float32, with infinity where there is no bound."""
    low = [-np.inf if one.low is None else one.low for one in dimensions]
    high = [np.inf if one.high is None else one.high for one in dimensions]
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32))


def layout_of(options: dict[str, Any] | None) -> int | None:
    """The fixed layout that reset's options ask for; ValueError for any other option."""
    options = options or {}
    unknown = set(options) - {"layout"}
    if unknown:
        raise ValueError(f"reset options: expected only 'layout', got {sorted(unknown)}")
    layout = options.get("layout")
    if layout is None:
        return None
    try:
        number = operator.index(layout)
    except TypeError:
        number = -1
    if isinstance(layout, bool) or not 0 <= number < 1 << 32:
        raise ValueError(
            f"reset options: layout: expected a whole number from 0 to 4294967295, got {layout!r}"
        )
    return number


def check_render_mode(render_mode: str | None) -> None:
    """ValueError for a mode that these environments do not have."""
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render mode: expected None or 'rgb_array', got {render_mode!r}")


def is_image(space: spaces.Space[Any]) -> bool:
    """A colour picture: uint8, rows, columns, red green blue."""
    return (
        isinstance(space, spaces.Box)
        and space.dtype == np.uint8
        and len(space.shape) == 3
        and space.shape[2] == 3
    )


def dimensions_of(space: spaces.Space[Any], name: str) -> tuple[Dimension, ...]:
    """What numbers a value of the space is made of; ValueError for spaces without a fixed number.

    Pictures and texts have none. name: of the space; parts are called name.part or name[index].
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
    """The value of an action space that is made of these numbers: numbers_of backwards."""
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


def images_of(space: spaces.Space[Any], value: Any) -> list[NDArray[np.uint8]]:
    """The pictures in a value, or in a space of values that are not there yet (value None)."""
    if is_image(space):
        return [np.zeros(space.shape or (), np.uint8) if value is None else np.asarray(value)]
    if not isinstance(space, (spaces.Dict, spaces.Tuple)):
        return []
    return [
        image
        for part, inner in _parts(space)
        for image in images_of(inner, None if value is None else value[part])
    ]


def _parts(space: "spaces.Dict | spaces.Tuple[Any]") -> list[tuple[Any, spaces.Space[Any]]]:
    if isinstance(space, spaces.Dict):
        return list(space.spaces.items())
    return list(enumerate(space.spaces))


def _bound(value: Any) -> float | None:
    """Types without infinity mark the missing bound by their largest number."""
    number = float(np.float32(value))
    return number if abs(number) < float(np.finfo(np.float32).max) else None
