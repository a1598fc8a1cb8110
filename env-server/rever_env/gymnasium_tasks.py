"""Gymnasium environments as tasks of a server: image, state, instruction, actions, limits."""

import dataclasses
import importlib
import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

import gymnasium
import numpy as np

from rever_env.fault import InvalidReset
from rever_env.protocol import Dimension
from rever_env.space_parts import Part, dimensions_of, parts_of

_log = logging.getLogger(__name__)

# Attributes that may hold an instruction outside of the observation, in order of preference.
_INSTRUCTION_ATTRIBUTES = (
    "task_description",
    "instruction",
    "language_instruction",
    "get_language_instruction",
)


@dataclass(frozen=True)
class Making:
    """Arguments of gymnasium.make beside the id, and the outermost wrapper."""

    arguments: Mapping[str, Any] = field(default_factory=dict)
    wrapper: Any = None

    def make(self, name: str, **arguments: Any) -> "gymnasium.Env[Any, Any]":
        """A new environment; InvalidReset if the id is unknown or the environment fails."""
        try:
            environment = gymnasium.make(name, **self.arguments, **arguments)
            return environment if self.wrapper is None else self.wrapper(environment)
        except Exception as error:  # the environment's code may raise errors of any type
            raise InvalidReset(f"environment {name}: {type(error).__name__}: {error}") from error


@dataclass(frozen=True)
class Keys:
    """Names of parts of the observation, such as `images.front`; None: chosen by their spaces."""

    image: str | None = None
    instruction: str | None = None
    state: tuple[str, ...] | None = None


@dataclass(frozen=True)
class GymnasiumTask:
    """An environment by its id; the other fields come from its spaces and its first reset."""

    name: str
    instruction: str  # of the first reset
    steps_max: int
    state: tuple[Dimension, ...]
    action: tuple[Dimension, ...]
    state_parts: tuple[Part, ...]
    image_part: Part | None  # None: the image comes from render()
    instruction_part: Part | None
    instruction_attribute: str | None
    renders: bool
    making: Making
    control_hz: float | None  # render_fps of its metadata
    variant: str = "default"
    version: int = 1
    layouts: tuple[()] = ()  # the seed draws every initial state

    @property
    def has_image(self) -> bool:
        """Whether observations have an image."""
        return self.image_part is not None or self.renders

    def instruction_of(self, environment: "gymnasium.Env[Any, Any]", observation: Any) -> str:
        """The present instruction."""
        if self.instruction_part is not None:
            return str(self.instruction_part.of(observation))
        said = _said(environment, self.instruction_attribute) if self.instruction_attribute else ""
        return said or self.instruction


def offered(
    names: Iterable[str],
    imports: Iterable[str],
    making: Making,
    horizon: int,
    keys: Keys | None = None,
) -> dict[str, GymnasiumTask]:
    """The named environments as tasks, by name.

    imports: packages that register ids when they are imported. horizon: step limit of environments
    whose id has none.
    """
    for package in imports:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise InvalidReset(f"package {package}: {error}") from error
    return {name: _task(name, making, horizon, keys or Keys()) for name in names}


def imported(path: str) -> Any:
    """The object that MODULE:NAME names."""
    module, _, name = path.partition(":")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise InvalidReset(f"expected MODULE:NAME, got {path}: {error}") from error


def has_limit(name: str) -> bool:
    """Whether the id has a step limit."""
    spec = gymnasium.registry.get(name)
    return spec is not None and spec.max_episode_steps is not None


def simulator(imports: Iterable[str]) -> str:
    """Names and versions of Gymnasium and of the packages that the environments come from."""
    names = ["gymnasium", *imports]
    return ", ".join(f"{name} {_version(name)}" for name in names)


def _task(name: str, making: Making, horizon: int, keys: Keys) -> GymnasiumTask:
    environment = making.make(name)
    try:
        try:
            parts = parts_of(environment.observation_space)
            state_parts = _state_parts(parts, keys.state)
            state = tuple(
                dimension for part in state_parts for dimension in part.dimensions("observation")
            )
            action = dimensions_of(environment.action_space, "action")
            image_part = _image_part(name, parts, keys.image)
            instruction_part = _instruction_part(name, parts, keys.instruction)
        except ValueError as error:
            raise InvalidReset(f"environment {name}: {error}") from error
        if not action:
            raise InvalidReset(f"environment {name}: expected actions of numbers, got none")
        try:
            observation, _ = environment.reset(seed=0)
        except Exception as error:  # of any type, as above
            raise InvalidReset(
                f"environment {name}: reset(seed=0) failed: {type(error).__name__}: {error}"
            ) from error
        attribute = None if instruction_part else _instruction_attribute(environment)
        spec = environment.spec
        steps_max = spec.max_episode_steps if spec else None
        if hasattr(environment.unwrapped, "compute_reward"):
            _log.warning(
                "environment %s: compute_reward cannot be called over the network; hindsight "
                "relabelling needs the environment in the trainer's process",
                name,
            )
        task = GymnasiumTask(
            name,
            name,
            horizon if steps_max is None else steps_max,
            state,
            action,
            state_parts,
            image_part,
            instruction_part,
            attribute,
            "rgb_array" in environment.metadata.get("render_modes", []),
            making,
            _control_hz(environment.metadata.get("render_fps")),
        )
        instruction = task.instruction_of(environment, observation) or name
        return dataclasses.replace(task, instruction=instruction)
    finally:
        environment.close()


def _state_parts(parts: list[Part], names: tuple[str, ...] | None) -> tuple[Part, ...]:
    """All numeric parts, or the named ones in the given order."""
    numeric = [part for part in parts if not part.is_text and not part.is_image]
    if names is None:
        return tuple(numeric)
    chosen = []
    for name in names:
        found = [part for part in numeric if part.is_within(name)]
        if not found:
            raise ValueError(f"state key {name}: expected one of {_names(numeric)}")
        chosen += found
    return tuple(chosen)


def _image_part(name: str, parts: list[Part], key: str | None) -> Part | None:
    """The image to serve: the named one or the first; a warning names the others."""
    images = [part for part in parts if part.is_image]
    if key is None and len(images) > 1:
        _log.warning(
            "environment %s: serving the image %s of its observation, not %s; choose another with "
            "--image-key",
            name,
            images[0].name,
            _names(images[1:]),
        )
    return _named(images, key, "image")


def _instruction_part(name: str, parts: list[Part], key: str | None) -> Part | None:
    """The instruction to serve: the named text or the first; a warning names the others."""
    texts = [part for part in parts if part.is_text]
    if key is None and len(texts) > 1:
        _log.warning(
            "environment %s: serving the text %s of its observation as the instruction, not %s; "
            "choose another one with --instruction-key",
            name,
            texts[0].name,
            _names(texts[1:]),
        )
    return _named(texts, key, "instruction")


def _named(parts: list[Part], key: str | None, kind: str) -> Part | None:
    if key is None:
        return parts[0] if parts else None
    for part in parts:
        if part.name == key:
            return part
    raise ValueError(f"{kind} key {key}: expected one of {_names(parts)}")


def _names(parts: list[Part]) -> str:
    return ", ".join(part.name for part in parts) or "none (the observation has no such part)"


def _instruction_attribute(environment: "gymnasium.Env[Any, Any]") -> str | None:
    for name in _INSTRUCTION_ATTRIBUTES:
        if _said(environment, name):
            return name
    return None


def _said(environment: "gymnasium.Env[Any, Any]", attribute: str) -> str:
    """The text of an attribute or of a method without arguments; empty if there is none."""
    try:
        value = environment.get_wrapper_attr(attribute)
    except AttributeError:
        return ""
    if callable(value):
        value = value()
    if isinstance(value, (list, tuple)) and len(value) == 1:
        value = value[0]  # an environment that is a batch of one
    return value if isinstance(value, str) else ""


def _control_hz(render_fps: object) -> float | None:
    """render_fps of the metadata, if it is a valid rate."""
    if not isinstance(render_fps, (int, float, np.number)) or isinstance(render_fps, bool):
        return None
    rate = float(render_fps)
    return rate if 0.0 < rate < math.inf else None


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "(unknown version)"
