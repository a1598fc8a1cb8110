"""The Gymnasium environments: one id per task, the same world behind each."""

from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rever_env import tasks
from rever_env.spaces import (
    RANDOM_SEEDS,
    check_render_mode,
    layout_of,
    observation_space,
)
from rever_env.world import Observation, World


class BridgeEnv(gymnasium.Env[dict[str, Any], NDArray[np.float64]]):
    """A task as a Gymnasium environment. variant: one of the task's in tasks.toml.

    observation: image uint8 (height, width, 3), state float32 (8,) in Bridge's order,
    instruction text. action: float64 (7,): dx dy dz (m), rotation vector (rad), gripper (+1 open).
    reset options: {"layout": 0..23} for a fixed layout; otherwise the seed draws one.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 (Gymnasium's form)

    def __init__(
        self,
        task: str,
        variant: str = tasks.DEFAULT,
        render_mode: str | None = "rgb_array",
        image_height: int = 128,
        image_width: int = 128,
    ) -> None:
        check_render_mode(render_mode)
        self.render_mode = render_mode
        description = tasks.find(tasks.load(), task, variant)
        self.world = World(description, image_height, image_width)
        self._last: Observation | None = None
        self.observation_space = observation_space(
            image_height, image_width, description.instruction, description.state
        )
        self.action_space = spaces.Box(-1.0, 1.0, (len(description.action),), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        layout = layout_of(options)
        layout_seed = seed if seed is not None else self._drawn_seed()
        self._last = self.world.reset(layout=layout, seed=layout_seed)
        return _fields(self._last), {"seed": layout_seed}

    def step(
        self, action: NDArray[np.float64]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        transition = self.world.step(action)
        self._last = transition.observation
        return (
            _fields(self._last),
            transition.reward,
            transition.terminated,
            transition.truncated,
            asdict(transition.statistics),
        )

    def render(self) -> NDArray[np.uint8] | None:
        if self.render_mode is None or self._last is None:
            return None
        return self._last.image

    def close(self) -> None:
        self.world.close()

    def _drawn_seed(self) -> int:
        return int(self.np_random.integers(RANDOM_SEEDS))


def _fields(observation: Observation) -> dict[str, Any]:
    return {
        "image": observation.image,
        "state": observation.state,
        "instruction": observation.instruction,
    }
