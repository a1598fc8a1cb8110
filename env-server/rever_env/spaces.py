"""Gymnasium's spaces for what the protocol describes."""

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

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
