"""LeRobot's EnvHub looks for this file: `make_env` gives every task as a vector of environments.

Observations have LeRobot's keys: pixels (uint8, height x width x 3) and agent_pos (float32, 8).
"""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from rever_env import tasks

_SUITE = "rever"
Fields = dict[str, Any]


class LeRobotEnv(gymnasium.Env[Fields, NDArray[np.float32]]):
    """One task under LeRobot's names; connect: a server elsewhere, None for a world of its own."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 (Gymnasium's form)

    def __init__(self, task: tasks.Task, connect: str | None, image_side: int) -> None:
        sizes: Fields = {"image_height": image_side, "image_width": image_side}
        inner = (
            gymnasium.make(task.gymnasium_id, disable_env_checker=True, **sizes)
            if connect is None
            else gymnasium.make("rever/Remote-v1", connect=connect, task=task.name, **sizes)
        )
        self._inner: Any = inner.unwrapped
        self.render_mode = "rgb_array"
        self.task = task.name
        self.task_description = task.instruction
        self._max_episode_steps = task.steps_max
        seen: Any = self._inner.observation_space
        self.observation_space = spaces.Dict({"pixels": seen["image"], "agent_pos": seen["state"]})
        self.action_space = spaces.Box(-1.0, 1.0, (7,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: Fields | None = None
    ) -> tuple[Fields, Fields]:
        super().reset(seed=seed)
        # LeRobot has options of its own.
        ours = {name: value for name, value in (options or {}).items() if name == "layout"}
        observation, info = self._inner.reset(seed=seed, options=ours)
        return _fields(observation), {**info, "is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[Fields, float, bool, bool, Fields]:
        observation, reward, terminated, truncated, info = self._inner.step(action)
        return _fields(observation), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8]:
        image: NDArray[np.uint8] = self._inner.render()
        return image

    def close(self) -> None:
        self._inner.close()


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None
) -> dict[str, dict[int, VectorEnv[Any, Any, Any]]]:
    """Every task, `n_envs` environments each.

    cfg may have `connect`, the endpoint of a server or router elsewhere, and `image_side`, in
    pixels (default: 256); worlds in this process otherwise.
    """
    connect = getattr(cfg, "connect", None)
    image_side = getattr(cfg, "image_side", 256)
    kind = AsyncVectorEnv if use_async_envs else SyncVectorEnv
    return {
        _SUITE: {
            index: kind([partial(LeRobotEnv, task, connect, image_side)] * n_envs)
            for index, task in enumerate(tasks.choose(tasks.load(), None))
        }
    }


def _fields(observation: Fields) -> Fields:
    return {"pixels": observation["image"], "agent_pos": observation["state"]}
