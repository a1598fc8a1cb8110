"""Any Gymnasium environment behind the protocol, by its id."""

import importlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env.fault import (
    Fault,
    InvalidAction,
    InvalidReset,
    PhysicsDiverged,
    RendererUnavailable,
)
from rever_env.layout import check_layout
from rever_env.protocol import Dimension
from rever_env.spaces import dimensions_of, images_of, numbers_of, value_of
from rever_env.success import success_alone
from rever_env.world import Observation, Transition, divergence, silence_warnings

_SUCCESSES = ("is_success", "success")
_SEED_END = 1 << 32  # numpy's older generators take no larger one


class NotReproducible(Fault):
    """The same reset and actions led elsewhere: what was saved cannot be restored."""


@dataclass(frozen=True)
class Making:
    """How an environment is made beside its id. wrapper: applied outermost."""

    arguments: Mapping[str, Any] = field(default_factory=dict)
    wrapper: Any = None

    def make(self, name: str, **arguments: Any) -> "gymnasium.Env[Any, Any]":
        """InvalidReset when there is no such environment or it does not take the arguments."""
        try:
            environment = gymnasium.make(name, **self.arguments, **arguments)
        except (gymnasium.error.Error, ImportError, TypeError) as error:
            raise InvalidReset(f"environment {name}: {error}") from error
        return environment if self.wrapper is None else self.wrapper(environment)


@dataclass(frozen=True)
class GymnasiumTask:
    """An environment by its id; what it is made of is read from its spaces."""

    name: str
    instruction: str
    steps_max: int
    state: tuple[Dimension, ...]
    action: tuple[Dimension, ...]
    shows_itself: bool  # a picture is in the observation
    renders: bool
    making: Making
    control_hz: float | None  # render_fps of its metadata
    variant: str = "default"
    version: int = 1
    layouts: tuple[()] = ()  # the seed draws every start

    @property
    def has_image(self) -> bool:
        """Whether there is a picture at all."""
        return self.shows_itself or self.renders


def offered(
    names: Iterable[str], imports: Iterable[str], making: Making, horizon: int
) -> dict[str, GymnasiumTask]:
    """Every named environment. imports: packages that register ids when they are imported.

    horizon: steps of environments whose id has no limit.
    """
    for package in imports:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise InvalidReset(f"package {package}: {error}") from error
    return {name: _task(name, making, horizon) for name in names}


def imported(path: str) -> Any:
    """What MODULE:NAME stands for."""
    module, _, name = path.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InvalidReset(f"expected MODULE:NAME, got {path}: {error}") from error


def simulator(imports: Iterable[str]) -> str:
    """Gymnasium with its version, and the packages that the environments come from."""
    names = ["gymnasium", *imports]
    return ", ".join(f"{name} {_version(name)}" for name in names)


class GymnasiumWorld:
    """One environment. Not thread-safe: use it in the thread that made it.

    The state is every number of the observation in the order of its space; the picture is the
    first in the observation, or else what the environment renders, brought to the size that was
    asked for. Success is what info says (is_success or success), or else a return that reaches the
    id's reward_threshold; without either no step is one. A saved state is the way to it: restoring
    resets and does the same actions again, and a fault tells when that leads elsewhere.
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
        self._environment = _make(task, self._size)
        threshold = self._environment.spec.reward_threshold if self._environment.spec else None
        self._reward_threshold = np.inf if threshold is None else threshold
        self._start: int | None = None
        self._actions: list[NDArray[np.float64]] = []
        self._has_ended = False
        self._ever_success = False
        self._return = 0.0
        self._last: Any = None

    def reset(self, *, layout: int | None, seed: int) -> Observation:
        """The same seed gives the same start, if the environment keeps Gymnasium's contract."""
        check_layout(self.task.name, layout, 0)
        return self._begin(seed)

    def step(self, action: NDArray[np.float64]) -> Transition:
        """action: float64, as many numbers as the task describes."""
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
        """The way to this state, and what is seen here."""
        seed = self._running()
        return seed, list(self._actions), self._seen()

    def restore(self, content: Any) -> Observation:
        """Goes the same way again."""
        seed, actions, expected = content
        observation = self._begin(seed)
        for action in actions:
            # With its picture, for some environments change their physics when they draw.
            observation = self._advance(action)[0]
        if not all(map(np.array_equal, self._seen(), expected)):
            self._start = None
            raise NotReproducible(f"task {self.task.name}: the same actions led to another state")
        return observation

    def expert_action(self) -> NDArray[np.float64]:
        raise InvalidAction(f"task {self.task.name} has no scripted expert")

    def close(self) -> None:
        self._environment.close()

    def _begin(self, seed: int) -> Observation:
        self._start, self._actions = seed, []
        self._has_ended = self._ever_success = False
        self._return = 0.0
        if seed >= _SEED_END:
            seed = int(np.random.SeedSequence(seed).generate_state(1)[0])
        np.random.seed(seed)  # for environments that draw from numpy's global generator
        self._last, _ = self._environment.reset(seed=seed)
        return self._observe()

    def _advance(
        self, action: NDArray[np.float64]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        value = value_of(self._environment.action_space, action)
        self._last, reward, terminated, truncated, info = self._environment.step(value)
        self._actions.append(action)
        self._return += float(reward)
        self._ever_success |= self._is_success(info)
        truncated = bool(truncated) or len(self._actions) >= self.task.steps_max
        self._has_ended = bool(terminated) or truncated
        return self._observe(), float(reward), bool(terminated), truncated, info

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
            raise InvalidAction("step or save before reset: expected a reset world")
        return self._start

    def _numbers(self) -> NDArray[np.float32]:
        numbers = numbers_of(self._environment.observation_space, self._last)
        return np.array(numbers, np.float32)

    def _seen(self) -> list[NDArray[Any]]:
        """The whole observation: its numbers and its pictures."""
        pictures = images_of(self._environment.observation_space, self._last)
        return [self._numbers(), *(picture.copy() for picture in pictures)]

    def _observe(self) -> Observation:
        data = getattr(self._environment.unwrapped, "data", None)
        warnings = divergence(data) if isinstance(data, mujoco.MjData) else []
        if warnings:
            self._start = None
            raise PhysicsDiverged(f"task {self.task.name}: MuJoCo started anew after {warnings}")
        numbers = self._numbers()
        for dimension, number in zip(self.task.state, numbers.tolist(), strict=True):
            if not np.isfinite(number):
                self._start = None
                raise PhysicsDiverged(f"task {self.task.name}: {dimension.name} is {number}")
        return Observation(self._image(), numbers, self.task.instruction)

    def _image(self) -> NDArray[np.uint8]:
        height, width = self._size
        if self._size == (0, 0):
            return np.empty((0, 0, 3), np.uint8)
        if self.task.shows_itself:
            image = images_of(self._environment.observation_space, self._last)[0]
        else:
            image = self._rendered()
        if image.shape[:2] == self._size:
            return np.array(image, order="C")  # an environment may draw into the same array again
        from PIL import Image

        # The mean of what each new pixel covers: a small picture must not lose thin things.
        resized = Image.fromarray(image).resize((width, height), Image.Resampling.BOX)
        return np.asarray(resized)

    def _rendered(self) -> NDArray[np.uint8]:
        renderer = getattr(self._environment.unwrapped, "mujoco_renderer", None)
        viewer = getattr(renderer, "viewer", None)
        if viewer is not None:
            # It draws into whatever OpenGL context is current, which may be another world's.
            viewer.make_context_current()
        try:
            image = np.asarray(self._environment.render())
        except Exception as error:
            raise RendererUnavailable(f"task {self.task.name}: {error}") from error
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            raise RendererUnavailable(
                f"task {self.task.name}: expected a picture uint8 (rows, columns, 3), "
                f"got {image.dtype} {image.shape}"
            )
        return image


def _task(name: str, making: Making, horizon: int) -> GymnasiumTask:
    environment = making.make(name)
    try:
        try:
            state = dimensions_of(environment.observation_space, "observation")
            action = dimensions_of(environment.action_space, "action")
        except ValueError as error:
            raise InvalidReset(f"environment {name}: {error}") from error
        if not action:
            raise InvalidReset(f"environment {name}: expected actions of numbers, got none")
        spec = environment.spec
        steps_max = spec.max_episode_steps if spec else None
        return GymnasiumTask(
            name,
            name,
            horizon if steps_max is None else steps_max,
            state,
            action,
            bool(images_of(environment.observation_space, None)),
            "rgb_array" in environment.metadata.get("render_modes", []),
            making,
            _control_hz(environment.metadata.get("render_fps")),
        )
    finally:
        environment.close()


def _control_hz(render_fps: object) -> float | None:
    """What the metadata say, if it is a rate."""
    if isinstance(render_fps, (int, float)) and 0.0 < render_fps < math.inf:
        return float(render_fps)
    return None


def _make(task: GymnasiumTask, size: tuple[int, int]) -> "gymnasium.Env[Any, Any]":
    """With a picture of that size where the environment lets it be chosen, or of any, or none."""
    if size == (0, 0) or task.shows_itself:
        return task.making.make(task.name)
    height, width = size
    try:
        return task.making.make(task.name, render_mode="rgb_array", height=height, width=width)
    except InvalidReset:
        return task.making.make(task.name, render_mode="rgb_array")


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "of no version"
