"""BridgeEnv: the four Bridge tasks as Gymnasium environments, one id per task."""

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
    """One of SIMPLER's four Bridge tasks: a WidowX arm over a table, simulated in MuJoCo.

    Arguments:
        task: SIMPLER's name of the task, such as "widowx_stack_cube".
        variant: a variant of the task in assets/tasks.toml, such as "distractors".
        render_mode: "rgb_array", or None for an environment whose render() returns None.
        image_height, image_width: pixels, 1 to 1024 each; 0 and 0 for no image.

    Observation (dict):
        image: uint8 (image_height, image_width, 3), RGB, rows from the top.
        state: float32 (8,). x y z of the gripper in metres and its roll pitch yaw in radians, both
            in the robot's base frame; 0; the opening of the gripper, 0 (closed) to 1 (open).
        instruction: str, such as "stack the green block on the yellow block".

    Action, float32 (7,): dx dy dz in metres and a rotation vector in radians, both in the base
    frame, then the gripper (+1 open, -1 closed). The bounds of action_space, 0.05 m and 0.25 rad,
    are what the arm can do in one step. Larger finite numbers are accepted. Actions add up to a
    commanded pose; the arm holds still while that pose is out of reach.

    Control rate: 5 steps per second of simulated time, 0.2 s each (metadata["render_fps"]).

    Reward: 1.0 for every step after which the task is solved, otherwise 0.0. The return is the
    number of such steps, so that it is not a success flag.

    Termination: never, because SIMPLER judges the last step. Truncation: after 60 steps, or 120
    for widowx_put_eggplant_in_basket.

    Info of step(), all bool:
        is_success: solved after this step. At the last step it is the episode's result.
        ever_success: solved after this or an earlier step.
        released_success: solved after this step, and the robot no longer touches the object.
        is_grasped: both fingers press the source object after this step.
        ever_grasped: is_grasped after this or an earlier step.
        consecutive_grasp: is_grasped was true for five steps in a row at some time so far.
        moved_correct_object: the source object has moved more than 3 cm and farther than any other.
        moved_wrong_object: another object has moved more than 3 cm and farther than the source.
        source_on_target: the source object lies on its target (here the same as is_success).
        action_followed: False where the gripper covered less than 30 % of the way to its commanded
            pose, because the pose is out of reach or something blocks the arm.
    Info of reset(): seed, int.

    Raises:
        rever_env.fault.InvalidReset: unknown task, variant or layout.
        rever_env.fault.Fault: the physics diverged, or no image can be rendered. The episode has no
            outcome; reset() begins a new one.
        ValueError: any other invalid argument, an action of the wrong shape or with a number that
            is not finite.
        gymnasium.error.ClosedEnvironmentError: used after close().
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
        """Executes one control step of 0.2 s; see the class for what it returns."""
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
        """The image of the last observation, uint8 (height, width, 3), as a copy.

        None before the first reset, without images, or with render_mode None.
        """
        if self.render_mode is None or self._last is None:
            return None
        return np.array(self._last.image)

    def close(self) -> None:
        """Frees the simulation; a second call does nothing."""
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
