"""What the Python tests share: the software renderer, one world per task, free ports."""

import os
import socket
from collections.abc import Iterator

import pytest

# Must be set before mujoco is imported; the tests are their own main.
os.environ.setdefault("MUJOCO_GL", "egl")

from rever_env import tasks
from rever_env.tasks import Task
from rever_env.world import World

TASKS = tasks.load()


@pytest.fixture(params=list(TASKS), scope="module")
def task(request: pytest.FixtureRequest) -> Task:
    """Every registered task in turn."""
    return TASKS[request.param]


@pytest.fixture(scope="module")
def world(task: Task) -> Iterator[World]:
    """A world of the task; each test resets it."""
    with World(task) as world:
        yield world


@pytest.fixture(scope="module")
def cube_world() -> Iterator[World]:
    """One task stands for all where the task makes no difference."""
    with World(TASKS["widowx_stack_cube"]) as world:
        yield world


def free_endpoint() -> str:
    """An endpoint of this machine alone that nobody uses now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{listener.getsockname()[1]}"
