"""A Gymnasium environment as a world of a server."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env import opengl
from rever_env.fault import (
    Fault,
    InvalidAction,
    InvalidReset,
    PhysicsDiverged,
    RendererUnavailable,
)
from rever_env.gymnasium_tasks import GymnasiumTask
from rever_env.layout import check_layout
from rever_env.space_parts import parts_of, value_of
from rever_env.success import success_alone
from rever_env.world import Observation, Transition, divergence, silence_warnings

_SUCCESSES = ("is_success", "success")
_SEED_END = 1 << 32  # numpy's older generators accept no larger seed


class NotReproducible(Fault):
    """The same reset and actions led to another state: a saved state cannot be restored."""


class GymnasiumWorld:
    """One environment. Any thread may use it, if the environment allows that, one at a time.

    State: the numbers of the observation in the order of its space, or of the named parts. Image:
    the first or the named one of the observation, otherwise what the environment renders; resized.
    Instruction: see GymnasiumTask. Success: is_success or success of info, otherwise a return that
    reaches the reward_threshold of the id; with neither, no step is a success. A saved state is the
    seed and the actions since reset: restore repeats them, and is a fault if the observation
    differs.
    """

    def __init__(self, task: GymnasiumTask, image_height: int, image_width: int) -> None:
        silence_warnings()
        self.task = task
        self._size = (image_height, image_width)
        wants_image = self._size != (0, 0)
        if wants_image and not task.has_image:
            raise InvalidReset(
                f"task {task.name} has no image: expected 0 x 0, got {image_height} x {image_width}"
            )
        with opengl.preserved_context():
            self._environment = _make(task, self._size)
        self._parts = parts_of(self._environment.observation_space)
        threshold = self._environment.spec.reward_threshold if self._environment.spec else None
        self._reward_threshold = np.inf if threshold is None else threshold
        self._start: int | None = None
        self._actions: list[NDArray[np.float64]] = []
        self._has_ended = False
        self._ever_success = False
        self._return = 0.0
        self._last: Any = None

    def reset(self, *, layout: int | None, seed: int) -> Observation:
        """The same seed gives the same start, if the environment keeps to Gymnasium's API."""
        check_layout(self.task.name, layout, 0)
        return self._begin(seed)

    def step(self, action: NDArray[np.float64]) -> Transition:
        """Executes one control step. action: float64, as many numbers as the task describes."""
        self._running()
        if self._has_ended:
            raise InvalidAction(
                f"step {len(self._actions) + 1}: expected a running episode, it has ended"
            )
        self._check(action)
        observation, reward, terminated, truncated, info = self._advance(action)
        return Transition(
            observation=observation,
            statistics=success_alone(self._is_success(info), self._ever_success),
            reward=reward,
            terminated=terminated,
            truncated=truncated,
        )

    def save(self) -> Any:
        """The seed and the actions that led here, and the whole observation."""
        seed = self._running()
        return seed, list(self._actions), self.seen()

    def restore(self, content: Any) -> Observation:
        """Resets with the saved seed and repeats the saved actions."""
        seed, actions, expected = content
        observation = self._begin(seed)
        for action in actions:
            # Rendered as well, because rendering changes the physics of some environments.
            observation = self._advance(action)[0]
        if self.seen() != expected:
            self._start = None
            raise NotReproducible(f"task {self.task.name}: the same actions led to another state")
        return observation

    def expert_action(self) -> NDArray[np.float64]:
        raise InvalidAction(f"task {self.task.name} has no scripted expert")

    def seen(self) -> list[bytes]:
        """The whole observation as bytes, part by part."""
        return [np.asarray(part.of(self._last)).tobytes() for part in self._parts]

    def close(self) -> None:
        with self._drawing():
            self._environment.close()

    def _begin(self, seed: int) -> Observation:
        self._start, self._actions = seed, []
        self._has_ended = self._ever_success = False
        self._return = 0.0
        if seed >= _SEED_END:
            seed = int(np.random.SeedSequence(seed).generate_state(1)[0])
        np.random.seed(seed)  # for environments that use numpy's global generator
        with self._drawing():
            self._last, _ = self._environment.reset(seed=seed)
            return self._observe()

    def _advance(
        self, action: NDArray[np.float64]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        value = value_of(self._environment.action_space, action)
        with self._drawing():
            self._last, reward, terminated, truncated, info = self._environment.step(value)
            observation = self._observe()
        self._actions.append(action)
        self._return += float(reward)
        self._ever_success |= self._is_success(info)
        truncated = bool(truncated) or len(self._actions) >= self.task.steps_max
        self._has_ended = bool(terminated) or truncated
        return observation, float(reward), bool(terminated), truncated, info

    def _check(self, action: NDArray[np.float64]) -> None:
        dimensions = self.task.action
        if action.shape != (len(dimensions),):
            raise InvalidAction(f"action: expected shape ({len(dimensions)},), got {action.shape}")
        for number, dimension in zip(action.tolist(), dimensions, strict=True):
            low, high = dimension.low, dimension.high
            if not dimension.discrete or low is None or high is None:
                continue
            if not (number.is_integer() and low <= number <= high):
                raise InvalidAction(
                    f"action {dimension.name}: expected a whole number from {low:g} to {high:g}, "
                    f"got {number:g}"
                )

    def _is_success(self, info: dict[str, Any]) -> bool:
        for key in _SUCCESSES:
            if key in info:
                return bool(np.asarray(info[key]).all())
        return self._return >= self._reward_threshold

    def _running(self) -> int:
        if self._start is None:
            raise InvalidAction("step or save before reset: call reset first")
        return self._start

    def _numbers(self) -> NDArray[np.float32]:
        numbers = [number for part in self.task.state_parts for number in part.numbers(self._last)]
        return np.array(numbers, np.float32)

    @contextmanager
    def _drawing(self) -> Iterator[None]:
        """Makes the OpenGL context of a MuJoCo environment's viewer current inside the block.

        Gymnasium assumes that it is; afterwards this thread has its previous context again.
        """
        with opengl.preserved_context():
            renderer = getattr(self._environment.unwrapped, "mujoco_renderer", None)
            viewer = getattr(renderer, "viewer", None)
            if viewer is not None:
                viewer.make_context_current()
            yield

    def _observe(self) -> Observation:
        data = getattr(self._environment.unwrapped, "data", None)
        warnings = divergence(data) if isinstance(data, mujoco.MjData) else []
        if warnings:
            self._start = None
            raise PhysicsDiverged(f"task {self.task.name}: MuJoCo reset itself after {warnings}")
        numbers = self._numbers()
        for dimension, number in zip(self.task.state, numbers.tolist(), strict=True):
            if not np.isfinite(number):
                self._start = None
                raise PhysicsDiverged(f"task {self.task.name}: {dimension.name} is {number}")
        instruction = self.task.instruction_of(self._environment, self._last)
        return Observation(self._image(), numbers, instruction)

    def _image(self) -> NDArray[np.uint8]:
        height, width = self._size
        if self._size == (0, 0):
            return np.empty((0, 0, 3), np.uint8)
        if self.task.image_part is not None:
            image = np.asarray(self.task.image_part.of(self._last))
        else:
            image = self._rendered()
        if image.shape[:2] == self._size:
            return np.array(image, order="C")  # a copy: the environment may reuse the array
        from PIL import Image

        # Each new pixel is the mean of the area it covers, so that thin objects stay visible.
        resized = Image.fromarray(image).resize((width, height), Image.Resampling.BOX)
        return np.asarray(resized)

    def _rendered(self) -> NDArray[np.uint8]:
        try:
            image = np.asarray(self._environment.render())
        except Exception as error:
            raise RendererUnavailable(f"task {self.task.name}: {error}") from error
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise RendererUnavailable(
                f"task {self.task.name}: expected an image uint8 (rows, columns, 3), "
                f"got {image.dtype} {image.shape}"
            )
        return image


def _make(task: GymnasiumTask, size: tuple[int, int]) -> "gymnasium.Env[Any, Any]":
    """A new environment, with images of this size where it accepts a size, or without images."""
    if size == (0, 0) or task.image_part is not None:
        return task.making.make(task.name)
    height, width = size
    try:
        return task.making.make(task.name, render_mode="rgb_array", height=height, width=width)
    except InvalidReset:
        return task.making.make(task.name, render_mode="rgb_array")
