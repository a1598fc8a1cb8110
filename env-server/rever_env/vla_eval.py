"""The Bridge tasks as a benchmark of vla-eval (vla-evaluation-harness), which must be installed.

Named by `benchmark: "rever_env.vla_eval:ReverBenchmark"` in an evaluation's file. Nothing else in
this package imports this module.
"""

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import (
    GRIPPER_01,
    GRIPPER_CLOSE_NEG,
    GRIPPER_CLOSE_POS,
    IMAGE_RGB,
    LANGUAGE,
    POSITION_DELTA,
    RAW,
    ROTATION_AA,
    DimSpec,
)

from rever_env import tasks
from rever_env.gymnasium_env import BridgeEnv

_SUITE = "rever"
# `rever evaluate` draws the seeds of initial layouts from this range.
_EVALUATION_SEEDS, _SEEDS_PER_RANGE = 3_000_000_000, 1_000_000_000
_GRID, _RANDOM = "grid", "random"
_GRIPPERS = {
    "open_positive": GRIPPER_CLOSE_NEG,  # this package's own: +1 opens, -1 closes
    "close_positive": GRIPPER_CLOSE_POS,  # -1 opens, +1 closes
    "open_one": GRIPPER_01,  # 1 opens, 0 closes
}


class ReverBenchmark(StepBenchmark):  # type: ignore[misc] # vla-eval has no types
    """SIMPLER's four WidowX Bridge tasks on MuJoCo, with the episodes of `rever evaluate`.

    Arguments:
        tasks: list of TASK, TASK/VARIANT or "all" (default: every task in its default variant).
        layouts: "grid" (episode K has initial layout K modulo the number of layouts) or "random"
            (drawn from the episode's seed).
        seed: as `rever evaluate --seed`; with the same seed, episode K of a task begins as there.
        image_height, image_width: pixels. A `rever serve-policy` asks for its policy's own size.
        send_state: whether observations have `states`, float32 (8,), as in BridgeEnv.
        gripper: what the last number of an action means: "open_positive" (+1 opens, -1 closes),
            "close_positive" (-1 opens, +1 closes) or "open_one" (1 opens, 0 closes).

    Observation: images {"primary": uint8 (image_height, image_width, 3)}, task_description, and
    states with send_state. Action: (7,) as in BridgeEnv, with a rotation vector in radians.
    Result: success at the last step; ever_success and the other flags of BridgeEnv's info.

    Raises rever_env.fault.InvalidReset for an unknown task, and ValueError for other arguments.
    """

    # Mesa's software device renders in both cases, so that images are the same on every machine.
    render_backends = frozenset({"gpu", "cpu"})

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Nothing: rever_env chooses its renderer by itself."""
        return {}

    def __init__(
        self,
        tasks: list[str] | None = None,
        layouts: str = _GRID,
        seed: int = 0,
        image_height: int = 224,
        image_width: int = 224,
        send_state: bool = False,
        gripper: str = "open_positive",
    ) -> None:
        super().__init__()
        if layouts not in (_GRID, _RANDOM):
            raise ValueError(f"layouts: expected {_GRID} or {_RANDOM}, got {layouts!r}")
        if gripper not in _GRIPPERS:
            raise ValueError(f"gripper: expected one of {', '.join(_GRIPPERS)}, got {gripper!r}")
        self._offered = _chosen(tasks)
        self._is_grid = layouts == _GRID
        self._seed = seed
        self._size: dict[str, Any] = {"image_height": image_height, "image_width": image_width}
        self._sends_state = send_state
        self._gripper = gripper
        self._env: BridgeEnv | None = None
        self._made_for = ""

    def get_tasks(self) -> list[dict[str, Any]]:
        """One per task and variant, in the order of tasks.toml."""
        return [{"name": name, "suite": _SUITE} for name in self._offered]

    def reset(self, task: dict[str, Any]) -> dict[str, Any]:
        """Begins the task's episode `episode_idx`."""
        offered = self._offered[task["name"]]
        if self._env is None or self._made_for != task["name"]:
            self.cleanup()
            self._env = BridgeEnv(offered.name, offered.variant, **self._size)
            self._made_for = task["name"]
        episode = int(task["episode_idx"])
        layout = {"layout": episode % len(offered.layouts)} if self._is_grid else None
        seed = layout_seed(offered.id, episode, self._seed)
        observation, _ = self._env.reset(seed=seed, options=layout)
        self._recorder.record_video(observation["image"])
        return observation

    def step(self, action: dict[str, Any]) -> StepResult:
        """Executes one control step."""
        if self._env is None:
            raise RuntimeError("step: expected a reset environment")
        numbers = self._numbers(action)
        observation, reward, terminated, truncated, info = self._env.step(numbers)
        self._recorder.record_video(observation["image"])
        self._recorder.record_step(
            action=numbers.tolist(),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
            success=info["is_success"],
        )
        return StepResult(observation, reward, terminated or truncated, info)

    def make_obs(self, raw_obs: dict[str, Any], task: dict[str, Any]) -> dict[str, Any]:
        """The observation in vla-eval's keys."""
        observation = {
            "images": {"primary": raw_obs["image"]},
            "task_description": raw_obs["instruction"],
        }
        if self._sends_state:
            observation["states"] = raw_obs["state"]
        return observation

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """Success at the last step, and the other flags."""
        flags = {name: bool(flag) for name, flag in step_result.info.items()}
        return {"success": flags["is_success"], **flags}

    def get_metric_keys(self) -> dict[str, str]:
        """Rates of success at the last step, and at any step."""
        return {"success": "mean", "ever_success": "mean"}

    def get_metadata(self) -> dict[str, Any]:
        """The longest horizon of the tasks, and what determines the episodes."""
        return {
            "max_steps": max(task.steps_max for task in self._offered.values()),
            "success_mode": "truncation",
            "seed": self._seed,
            "layouts": _GRID if self._is_grid else _RANDOM,
        }

    def get_hold_action(self, last_action: dict[str, Any] | None) -> dict[str, Any]:
        """No motion, with the last gripper command; open before the first one."""
        held = np.zeros(7, dtype=np.float32)
        held[6] = 1.0 if last_action is None else self._numbers(last_action)[6]
        return {"actions": self._in_form(held)}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """The conventions of an action."""
        gripper = _GRIPPERS[self._gripper]
        return {"position": POSITION_DELTA, "rotation": ROTATION_AA, "gripper": gripper}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """What an observation holds."""
        spec = {"primary": IMAGE_RGB, "language": LANGUAGE}
        return {**spec, "state": RAW} if self._sends_state else spec

    def render(self) -> NDArray[np.uint8] | None:
        """The image of the last observation."""
        return None if self._env is None else self._env.render()

    def cleanup(self) -> None:
        """Closes the environment."""
        if self._env is not None:
            self._env.close()
            self._env = None

    def _numbers(self, action: dict[str, Any]) -> NDArray[np.float32]:
        """An action in BridgeEnv's convention, which checks its shape and its numbers."""
        numbers = np.array(action["actions"], dtype=np.float32)
        if numbers.ndim == 2 and len(numbers) == 1:
            numbers = numbers[0]
        if self._gripper != "open_positive" and numbers.shape == (7,):
            opens = numbers[6] < 0 if self._gripper == "close_positive" else numbers[6] > 0.5
            numbers[6] = 1.0 if opens else -1.0
        return numbers

    def _in_form(self, numbers: NDArray[np.float32]) -> NDArray[np.float32]:
        """An action of BridgeEnv's convention in this benchmark's."""
        opens = numbers[6] > 0
        if self._gripper == "close_positive":
            numbers[6] = -1.0 if opens else 1.0
        elif self._gripper == "open_one":
            numbers[6] = 1.0 if opens else 0.0
        return numbers


def layout_seed(task: tasks.TaskId, episode: int, seed: int) -> int:
    """The seed of an episode's initial layout in `rever evaluate`."""
    name = f"place/{task.task}/{task.variant}/{episode}/{seed}"
    hashed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
    return _EVALUATION_SEEDS + hashed % _SEEDS_PER_RANGE


def _chosen(names: list[str] | None) -> dict[str, tasks.Task]:
    return {str(task.id): task for task in tasks.choose(tasks.load(), names)}
