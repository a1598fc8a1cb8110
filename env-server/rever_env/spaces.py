"""Gymnasium's spaces for what the protocol describes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from rever_env.instruction import Instruction
from rever_env.protocol import Dimension

RANDOM_SEEDS = 1_000_000_000  # seeds drawn by reset(seed=None) lie below this


def observation_space(height: int, width: int, state: Sequence[Dimension]) -> spaces.Dict:
    """image uint8 (height, width, 3), state float32 (as many as described,), instruction text.

    Without pixels there is no image, and without numbers no state.
    """
    fields: dict[str, spaces.Space[Any]] = {}
    if height and width:
        fields["image"] = spaces.Box(0, 255, (height, width, 3), np.uint8)
    if state:
        fields["state"] = box(state)
    fields["instruction"] = Instruction()
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


def metadata_of(control_hz: float | None) -> dict[str, Any]:
    """An environment's metadata: videos play at its control rate, where that is known."""
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}
    if control_hz is not None:
        metadata["render_fps"] = int(control_hz) if control_hz.is_integer() else control_hz
    return metadata
