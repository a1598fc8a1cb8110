"""The Bridge tasks for LeRobot's EnvHub: make_env and environments with LeRobot's keys."""

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
    """One Bridge task with LeRobot's observation keys.

    Arguments:
        task: TASK or TASK/VARIANT.
        connect: endpoint of a server; None simulates in this process.
        image_side: pixels per side of the square image.

    Observation (dict): pixels, uint8 (image_side, image_side, 3), RGB; agent_pos, float32 (8,), the
    state of BridgeEnv. The instruction is the attribute task_description.
    Action, control rate, reward, termination, truncation and errors: as in BridgeEnv, or in
    RemoteEnv with connect.
    Info: as in BridgeEnv, except that is_success is the episode's result and False before the last
    step: LeRobot counts an episode as a success if is_success is true at any step.
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
        """Begins an episode. options: {"layout": K} for a fixed layout; others are ignored."""
        super().reset(seed=seed)
        own = {name: value for name, value in (options or {}).items() if name == "layout"}
        observation, info = self._inner.reset(seed=seed, options=own)
        return self._fields(observation), {**info, "is_success": False}

    def step(self, action: NDArray[np.float32]) -> tuple[Fields, float, bool, bool, Fields]:
        """Executes one control step; see the class for what it returns."""
        observation, reward, terminated, truncated, info = self._inner.step(action)
        info["is_success"] = info["is_success"] and (terminated or truncated)
        return self._fields(observation), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8]:
        """The image of the last observation, uint8 (image_side, image_side, 3)."""
        image: NDArray[np.uint8] = self._inner.render()
        return image

    def close(self) -> None:
        """Closes the simulation or the session."""
        self._inner.close()

    def _fields(self, observation: Fields) -> Fields:
        self.task_description = observation["instruction"]  # of this episode
        return {"pixels": observation["image"], "agent_pos": observation["state"]}


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None
) -> dict[str, dict[int, VectorEnv[Any, Any, Any]]]:
    """Vector environments for LeRobot, as {"rever": {index of the task: vector}}.

    Arguments:
        n_envs: environments per task.
        use_async_envs: one process per environment (AsyncVectorEnv) instead of SyncVectorEnv.
        cfg: object with any of these attributes. connect: endpoint of a server or router (default:
            simulate in this process). image_side: pixels (default: 256). tasks: list of TASK or
            TASK/VARIANT (default: every task in its default variant).

    The vectors reset at the last step of an episode (AutoresetMode.SAME_STEP): LeRobot reads the
    success of an episode from info["final_info"], which only this mode provides.

    Raises rever_env.fault.InvalidReset for an unknown task, and what LeRobotEnv raises.
    """
    connect = getattr(cfg, "connect", None)
    image_side = getattr(cfg, "image_side", _SIDE)
    # zenoh does not survive a fork.
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
