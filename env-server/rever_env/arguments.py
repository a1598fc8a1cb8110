"""Arguments of environments: the same checks for local and remote ones."""

import operator
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rever_env.protocol import limits


def layout_of(options: dict[str, Any] | None) -> int | None:
    """The fixed initial layout in the options of reset(); ValueError for any other option."""
    options = options or {}
    unknown = set(options) - {"layout"}
    if unknown:
        raise ValueError(f"reset options: expected only 'layout', got {sorted(unknown)}")
    layout = options.get("layout")
    if layout is None:
        return None
    return _whole("reset options: layout", layout, (1 << 32) - 1)


def seed_of(seed: Any) -> int | None:
    """The seed as an int, also from a numpy integer; ValueError outside the protocol's range."""
    return None if seed is None else _whole("seed", seed, limits.SEED_END - 1)


def image_size(height: Any, width: Any) -> tuple[int, int]:
    """Height and width in pixels; both are 0 for no image."""
    sides = (
        _whole("image_height", height, limits.IMAGE_SIDE_MAX),
        _whole("image_width", width, limits.IMAGE_SIDE_MAX),
    )
    if (sides[0] == 0) != (sides[1] == 0):
        raise ValueError(
            f"image size: expected both sides 0 (no image) or neither, got {sides[0]} x {sides[1]}"
        )
    return sides


def check_render_mode(render_mode: str | None) -> None:
    """ValueError for a render mode that these environments do not support."""
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render mode: expected None or 'rgb_array', got {render_mode!r}")


def action_numbers(space: spaces.Space[Any], action: Any) -> NDArray[np.float32]:
    """The action as float32; ValueError for a wrong shape or numbers that are not finite.

    Numbers outside the bounds of the space are allowed: the environment decides what they do.
    """
    array = np.asarray(action)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"action: expected numbers, got {action!r}")
    if array.shape != space.shape:
        raise ValueError(f"action: expected shape {space.shape}, got {array.shape}")
    with np.errstate(over="ignore"):  # overflow gives infinity, which is refused below
        numbers = array.astype(np.float32)
    if not np.isfinite(numbers).all():
        raise ValueError(f"action: expected finite numbers, got {array.tolist()}")
    return numbers


def _whole(name: str, value: Any, largest: int) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        number = -1
    if isinstance(value, (bool, np.bool_)) or not 0 <= number <= largest:
        raise ValueError(f"{name}: expected a whole number from 0 to {largest}, got {value!r}")
    return number
