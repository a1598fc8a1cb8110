"""The Gymnasium environments: one id per task, the same world behind each."""

from dataclasses import asdict
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from rever_env import tasks
from rever_env.arguments import (
    action_numbers,
    check_render_mode,
    image_size,
    layout_of,
    seed_of,
)
from rever_env.followed import CommandedPose
from rever_env.spaces import RANDOM_SEEDS, action_space, metadata_of, observation_space
from rever_env.world import Observation, World


class BridgeEnv(gymnasium.Env[dict[str, Any], NDArray[np.float32]], EzPickle):
    """One of the four Bridge tasks: a WidowX arm on a table, 5 control steps per second.

    Arguments
        task: SIMPLER's name. variant: one of the task's in tasks.toml.
        image_height, image_width: pixels, 1 to 1024; 0 and 0 for no image.

    Observation: image uint8 (height, width, 3); state float32 (8,): x y z (m) roll pitch yaw (rad)
    of the gripper in the base's frame, 0, gripper opening 0 to 1; instruction text.
    Action: float32 (7,): dx dy dz (m), rotation vector (rad), both in the base's frame, gripper
    (+1 open, -1 closed). The bounds of action_space are what the arm can do in one step; larger
    actions are taken too. The arm holds still where the commanded pose is out of reach.
    Reward: 1.0 at every step after which the task is solved, otherwise 0.0; a return counts steps.
    Episodes never terminate, because SIMPLER judges the last step: they are truncated after 60
    steps, or 120 (eggplant).
    info of a step: is_success (now; the episode's result at its last step), ever_success,
    released_success, is_grasped, ever_grasped, consecutive_grasp, moved_correct_object,
    moved_wrong_object, source_on_target, and action_followed: False where the gripper came less
    than 30 % of the way to its commanded pose, because that is out of reach or something blocks it.

    Raises rever_env.fault.Fault when the physics diverges or no image can be drawn, which is never
    a reward, and its kind InvalidReset for a task, variant or layout that there is not; ValueError
    for other invalid arguments, and gymnasium.error.ClosedEnvironmentError after close.
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
        EzPickle.__init__(self, task, variant, render_mode, image_height, image_width)
        self._is_closed = True
        check_render_mode(render_mode)
        height, width = image_size(image_height, image_width)
        description = tasks.find(tasks.load(), task, variant)
        self.observation_space = observation_space(height, width, description.state)
        self._names = set(self.observation_space.spaces)
        self.action_space: spaces.Space[Any] = action_space(description.action)
        self.render_mode = render_mode if height else None
        self.metadata = metadata_of(description.control_hz)
        self.world = World(description, height, width)
        self._is_closed = False
        self._last: Observation | None = None
        self._commanded: CommandedPose | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begins an episode; the same seed and options give the same one.

        seed: 0 to 2^53 - 1; None draws one. options: {"layout": 0..23} for one of SIMPLER's initial
        layouts; otherwise the seed draws a random one. info: seed.
        """
        self._require_open()
        layout, seed = layout_of(options), seed_of(seed)
        super().reset(seed=seed)
        used = int(self.np_random.integers(RANDOM_SEEDS)) if seed is None else seed
        self._last = self.world.reset(layout=layout, seed=used)
        self._commanded = CommandedPose(self._last.state)
        return self._fields(self._last), {"seed": used}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step of 0.2 s: observation, reward, terminated, truncated, info."""
        self._require_open()
        numbers = action_numbers(self.action_space, action)
        transition = self.world.step(numbers.astype(np.float64))
        self._last = transition.observation
        info: dict[str, Any] = asdict(transition.statistics)
        if self._commanded is not None:
            info["action_followed"] = self._commanded.follow(numbers, self._last.state)
        return (
            self._fields(self._last),
            transition.reward,
            transition.terminated,
            transition.truncated,
            info,
        )

    def render(self) -> NDArray[np.uint8] | None:
        """A copy of the last observation's image; None before the first reset."""
        if self.render_mode is None or self._last is None:
            return None
        return np.array(self._last.image)

    def close(self) -> None:
        """Frees the world; a second call does nothing."""
        if not self._is_closed:
            self._is_closed = True
            self.world.close()

    def _require_open(self) -> None:
        if self._is_closed:
            raise ClosedEnvironmentError("expected an open environment: close() was called")

    def _fields(self, observation: Observation) -> dict[str, Any]:
        fields = {
            "image": observation.image,
            "state": observation.state,
            "instruction": observation.instruction,
        }
        return {name: value for name, value in fields.items() if name in self._names}
