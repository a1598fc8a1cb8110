"""Worlds: a limited pool of the worlds of a server, created on demand and reused."""

import logging
from collections import deque
from collections.abc import Callable, Mapping, Sized
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rever_env.protocol import Dimension, limits
from rever_env.tasks import TaskId
from rever_env.world import Observation, Transition, World

_log = logging.getLogger(__name__)

Key = tuple[str, str, int, int]
Maker = Callable[[Any, int, int], "AnyWorld"]


class OfferedTask(Protocol):
    """A task as a server describes it."""

    @property
    def name(self) -> str: ...
    @property
    def variant(self) -> str: ...
    @property
    def version(self) -> int: ...
    @property
    def instruction(self) -> str: ...
    @property
    def steps_max(self) -> int: ...
    @property
    def control_hz(self) -> float | None: ...
    @property
    def layouts(self) -> Sized: ...
    @property
    def state(self) -> tuple[Dimension, ...]: ...
    @property
    def action(self) -> tuple[Dimension, ...]: ...


class AnyWorld(Protocol):
    """The interface of a simulator for sessions. Errors: see rever_env.fault."""

    def reset(self, *, layout: int | None, seed: int) -> Observation:
        """Begins an episode; the same arguments give the same bytes."""
        ...

    def step(self, action: NDArray[np.float64]) -> Transition:
        """Executes one control step."""
        ...

    def save(self) -> Any:
        """The complete state, for restore() of a world with the same key."""
        ...

    def restore(self, content: Any) -> Observation:
        """Returns to a saved state, bit-exact."""
        ...

    def expert_action(self) -> NDArray[np.float64]:
        """The action of the scripted expert, if the task has one."""
        ...

    def close(self) -> None:
        """Frees the world's memory and contexts."""
        ...


class UnknownTask(ValueError):
    """The server does not offer the task or its variant."""


class Worlds:
    """The pool. Not thread-safe.

    Worlds have no memory between episodes, so that sessions can use them in turn. idle_max: number
    of unused worlds to keep, because creating one takes tens of milliseconds. image_side_max: 0 if
    the worlds have no images.
    """

    def __init__(
        self,
        tasks: Mapping[str, OfferedTask],
        idle_max: int,
        make: Maker = World,
        simulator: str = "rever_env",
        image_side_max: int = limits.IMAGE_SIDE_MAX,
    ) -> None:
        self.simulator = simulator
        self.image_side_max = image_side_max
        self.tasks = {(task.name, task.variant): task for task in tasks.values()}
        self._idle_max = idle_max
        self._make = make
        self._idle: deque[tuple[Key, AnyWorld]] = deque()

    def task(self, name: str, variant: str) -> OfferedTask:
        """The task; UnknownTask if it is not offered."""
        task = self.tasks.get((name, variant))
        if task is None:
            offered = ", ".join(str(TaskId(*known)) for known in self.tasks)
            raise UnknownTask(f"task {TaskId(name, variant)}: expected one of {offered}")
        return task

    def take(self, key: Key) -> AnyWorld:
        """A world for the caller's exclusive use. key: task, variant, image height, image width."""
        for index, (idle_key, world) in enumerate(self._idle):
            if idle_key == key:
                del self._idle[index]
                return world
        name, variant, height, width = key
        return self._make(self.task(name, variant), height, width)

    def give_back(self, key: Key, world: AnyWorld) -> None:
        """Keeps a world for reuse; closes the least recently used one beyond idle_max."""
        self._idle.append((key, world))
        if len(self._idle) > self._idle_max:
            self.discard(self._idle.popleft()[1])

    def discard(self, world: AnyWorld) -> None:
        """Closes a world. Environments of other projects may raise even then."""
        try:
            world.close()
        except Exception:
            _log.exception("cannot close a world")

    def close(self) -> None:
        """Closes the idle worlds."""
        while self._idle:
            self.discard(self._idle.pop()[1])
