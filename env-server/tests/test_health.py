"""A server that works is healthy, one that is stopped or absent is not."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import free_endpoint

from rever_env.tasks import TaskId, load


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "rever_env", "serve", "--exit-with-parent"]
    server = subprocess.Popen(
        [*command, "--listen", endpoint, "--id-file", str(tmp_path / "id")],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    yield server, endpoint
    server.kill()
    server.communicate()


def health(endpoint: str, timeout_secs: str, *more: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rever_env", "health", "--connect", endpoint]
    return subprocess.run(
        [*command, "--timeout-secs", timeout_secs, *more],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_only_a_server_that_works_is_healthy(
    served: tuple[subprocess.Popen[str], str], tmp_path: Path
) -> None:
    server, endpoint = served
    assert server.stdout is not None
    name = server.stdout.readline().split()[1]
    working = health(endpoint, "60")
    assert (working.returncode, working.stderr) == (0, "")
    tasks = ", ".join(str(TaskId(task.name, task.variant)) for task in load().values())
    assert working.stdout == f"{name}: 0 of 16 sessions in use; tasks: {tasks}\n"

    assert health(endpoint, "60", "--id-file", str(tmp_path / "id")).stdout == working.stdout
    (tmp_path / "other").write_text("another")
    other = health(endpoint, "0.5", "--id-file", str(tmp_path / "other"))
    assert (other.returncode, other.stdout) == (1, "")

    server.send_signal(signal.SIGSTOP)
    stopped = health(endpoint, "0.5")
    assert (stopped.returncode, stopped.stdout) == (1, "")
    assert f"no server of fleet local answered at {endpoint}" in stopped.stderr
