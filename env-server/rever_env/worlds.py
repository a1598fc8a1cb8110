"""The worlds of one process: made when first needed, handed from session to session, limited."""

from collections import deque
from collections.abc import Callable, Mapping

from rever_env.tasks import Task
from rever_env.world import World

Key = tuple[str, str, int, int]
Maker = Callable[[Task, int, int], World]


class UnknownTask(ValueError):
    """The task or its variant is not offered here."""


class Worlds:
    """Not thread-safe: use it in the thread that renders.

    A world carries nothing from one episode to the next, so it does not matter which one a session
    gets. idle_max: worlds kept that no session uses; making one takes tens of milliseconds.
    """

    def __init__(self, tasks: Mapping[str, Task], idle_max: int, make: Maker = World) -> None:
        self.tasks = {(task.name, task.variant): task for task in tasks.values()}
        self._idle_max = idle_max
        self._make = make
        self._idle: deque[tuple[Key, World]] = deque()

    def task(self, name: str, variant: str) -> Task:
        """The task; UnknownTask when it is not offered."""
        task = self.tasks.get((name, variant))
        if task is None:
            offered = ", ".join(f"{name} ({variant})" for name, variant in self.tasks)
            raise UnknownTask(f"expected one of the tasks {offered}, got {name} ({variant})")
        return task

    def take(self, key: Key) -> World:
        """A world for the caller alone. key: task, variant, image height, image width."""
        for index, (idle_key, world) in enumerate(self._idle):
            if idle_key == key:
                del self._idle[index]
                return world
        name, variant, height, width = key
        return self._make(self.task(name, variant), height, width)

    def give_back(self, key: Key, world: World) -> None:
        """Keeps a sound world for the next taker; closes the one unused for longest if need be."""
        self._idle.append((key, world))
        if len(self._idle) > self._idle_max:
            self._idle.popleft()[1].close()

    def close(self) -> None:
        """Closes the idle worlds."""
        while self._idle:
            self._idle.pop()[1].close()
