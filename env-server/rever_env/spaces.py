"""What Bridge environments have in common as Gymnasium sees them, here and in servers elsewhere."""

from typing import Any

import numpy as np
from gymnasium import spaces

RANDOM_SEEDS = 1_000_000_000  # seeds drawn by reset(seed=None) lie below this

# x y z (m, base frame), roll pitch yaw (rad), pad, gripper opening.
_STATE_HIGH = np.array([2.0, 2.0, 2.0, np.pi, np.pi, np.pi, 1.0, 1.0], np.float32)
_STATE_LOW = np.array([-2.0, -2.0, -2.0, -np.pi, -np.pi, -np.pi, 0.0, 0.0], np.float32)


def observation_space(height: int, width: int, instruction: str) -> spaces.Dict:
    """image uint8 (height, width, 3), state float32 (8,) in Bridge's order, instruction text."""
    return spaces.Dict(
        {
            "image": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "state": spaces.Box(_STATE_LOW, _STATE_HIGH),
            "instruction": spaces.Text(
                max_length=max(len(instruction), 1), charset="".join(sorted(set(instruction)))
            ),
        }
    )


def configuration_of(options: dict[str, Any] | None) -> int | None:
    """The fixed placement that reset's options ask for; ValueError for any other option."""
    options = options or {}
    unknown = set(options) - {"configuration"}
    if unknown:
        raise ValueError(f"reset options: expected only 'configuration', got {sorted(unknown)}")
    return options.get("configuration")


def check_render_mode(render_mode: str | None) -> None:
    """ValueError for a mode that these environments do not have."""
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render mode: expected None or 'rgb_array', got {render_mode!r}")
