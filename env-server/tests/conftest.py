"""What the Python tests share: the software renderer, worlds, free ports and server processes."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
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


def serve(endpoint: str, *arguments: str) -> "subprocess.Popen[str]":
    """A server process that is ready; whoever starts it ends it."""
    process = subprocess.Popen(
        [sys.executable, "-m", "rever_env", "serve", "--listen", endpoint, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline().startswith("ready ")
    return process


def end(process: "subprocess.Popen[str]") -> None:
    """Kills a server, stopped or not."""
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            stream.close()


def pause(process: "subprocess.Popen[str]") -> None:
    """Stops a child and returns when it has stopped."""
    os.kill(process.pid, signal.SIGSTOP)
    os.waitpid(process.pid, os.WUNTRACED)


@contextlib.contextmanager
def served(*arguments: str) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """The endpoint of a server, and its process."""
    endpoint = free_endpoint()
    process = serve(endpoint, *arguments)
    try:
        yield endpoint, process
    finally:
        end(process)


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """A server of the Bridge tasks."""
    with served() as (endpoint, _):
        yield endpoint
