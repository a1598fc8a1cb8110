"""Gymnasium spaces for the states and actions that the protocol describes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from rever_env.instruction import Instruction
from rever_env.protocol import Dimension

RANDOM_SEEDS = 1_000_000_000  # reset(seed=None) draws a seed below this


def observation_space(height: int, width: int, state: Sequence[Dimension]) -> spaces.Dict:
    """Dict of image uint8 (height, width, 3), state float32 (len(state),) and instruction (text).

    Without pixels there is no image; without numbers there is no state.
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
    """Discrete for one discrete number, MultiDiscrete for several, otherwise a float32 Box."""
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
    """A float32 Box, infinite where a number has no bound."""
    low = [-np.inf if one.low is None else one.low for one in dimensions]
    high = [np.inf if one.high is None else one.high for one in dimensions]
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32))


def metadata_of(control_hz: float | None) -> dict[str, Any]:
    """An environment's metadata; render_fps is the control rate, if it is known."""
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}
    if control_hz is not None:
        metadata["render_fps"] = int(control_hz) if control_hz.is_integer() else control_hz
    return metadata
