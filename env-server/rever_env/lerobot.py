"""The tasks under LeRobot's names: what its EnvHub asks for, as vectors of environments.

Observations have LeRobot's keys: pixels (uint8, height x width x 3) and agent_pos (float32, 8).
"""

import multiprocessing
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from numpy.typing import NDArray

from rever_env import tasks

_SUITE = "rever"
_SIDE = 256  # pixels
Fields = dict[str, Any]


class LeRobotEnv(gymnasium.Env[Fields, NDArray[np.float32]], EzPickle):
    """One task, as TASK or TASK/VARIANT.

    connect: a server elsewhere; None for a world in this process.
    info["is_success"] is the episode's result, False before the last step: LeRobot counts an
    episode as a success where any of its steps says so.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012 (Gymnasium's form)

    def __init__(self, task: str, connect: str | None = None, image_side: int = _SIDE) -> None:
        EzPickle.__init__(self, task, connect, image_side)
        name, variant = tasks.TaskId.parse(task)
        sizes: Fields = {"image_height": image_side, "image_width": image_side}
        if connect is None:
            from rever_env.gymnasium_env import BridgeEnv

            self._inner: Any = BridgeEnv(name, variant, **sizes)
        else:
            from rever_env.remote import RemoteEnv

            self._inner = RemoteEnv(connect, name, variant, **sizes)
        offered = tasks.find(tasks.load(), name, variant)
        self.render_mode = "rgb_array"
        self.metadata = self._inner.metadata
        self.task = task
        self.task_description = offered.instruction
        self._max_episode_steps = offered.steps_max
        seen = self._inner.observation_space
        self.observation_space = spaces.Dict({"pixels": seen["image"], "agent_pos": seen["state"]})
        self.action_space = self._inner.action_space

    def reset(
        self, *, seed: int | None = None, options: Fields | None = None
    ) -> tuple[Fields, Fields]:
        """As of the environment inside; LeRobot's own options are left out."""
        super().reset(seed=seed)
        own = {name: value for name, value in (options or {}).items() if name == "layout"}
        observation, info = self._inner.reset(seed=seed, options=own)
        return self._fields(observation), {**info, "is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[Fields, float, bool, bool, Fields]:
        """As of the environment inside."""
        observation, reward, terminated, truncated, info = self._inner.step(action)
        info["is_success"] = info["is_success"] and (terminated or truncated)
        return self._fields(observation), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8]:
        """The last observation's image."""
        image: NDArray[np.uint8] = self._inner.render()
        return image

    def close(self) -> None:
        """Closes the environment inside."""
        self._inner.close()

    def _fields(self, observation: Fields) -> Fields:
        self.task_description = observation["instruction"]  # of this episode
        return {"pixels": observation["image"], "agent_pos": observation["state"]}


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None
) -> dict[str, dict[int, VectorEnv[Any, Any, Any]]]:
    """Every task by its number, `n_envs` environments each.

    cfg may have `connect`, the endpoint of a server or router elsewhere (None: worlds in this
    process), `image_side` in pixels (default: 256), and `tasks`, a list of TASK or TASK/VARIANT
    (default: every task).

    The last step begins the next episode (SAME_STEP): LeRobot reads an episode's success from
    info["final_info"], which only this mode has.
    """
    connect = getattr(cfg, "connect", None)
    image_side = getattr(cfg, "image_side", _SIDE)
    # A forked process cannot use the network that its parent has opened.
    forkserver = "forkserver" in multiprocessing.get_all_start_methods()
    start_method = "forkserver" if forkserver else "spawn"
    vectors: dict[int, VectorEnv[Any, Any, Any]] = {}
    for index, task in enumerate(tasks.choose(tasks.load(), getattr(cfg, "tasks", None))):
        makers = [partial(LeRobotEnv, str(task.id), connect, image_side)] * n_envs
        vectors[index] = (
            AsyncVectorEnv(makers, context=start_method, autoreset_mode=AutoresetMode.SAME_STEP)
            if use_async_envs
            else SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
        )
    return {_SUITE: vectors}
