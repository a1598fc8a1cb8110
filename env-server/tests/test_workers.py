"""Worker processes of `demonstrate` when the process that started them ends."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

SECONDS_MAX = 120.0
SECONDS_TO_END_MAX = 20.0


def processes_of_session(session: int) -> list[int]:
    """The running processes of a session, from /proc; those that have ended do not count."""
    found = []
    for folder in Path("/proc").iterdir():
        if not folder.name.isdecimal():
            continue
        try:
            # After the name in parentheses: state, parent, process group, session.
            state, _, _, group = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue  # it has ended since
        if int(group) == session and state not in "ZX":
            found.append(int(folder.name))
    return found


def wait_until(condition: Callable[[], bool], seconds_max: float, what: str) -> None:
    deadline = time.monotonic() + seconds_max
    while not condition():
        assert time.monotonic() < deadline, f"{what}: expected within {seconds_max} s"
        time.sleep(0.05)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_their_parent(number: signal.Signals, tmp_path: Path) -> None:
    words = "demonstrate --tasks widowx_stack_cube --episodes 100000 --processes 2 --out"
    parent = subprocess.Popen(
        [sys.executable, "-m", "rever_env", *words.split(), str(tmp_path)],
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        # A shell starts background jobs, and so what they start, with SIGINT ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        folder = tmp_path / "widowx_stack_cube"
        wait_until(lambda: any(folder.glob("*.npz")), SECONDS_MAX, "an episode")
        # The parent, two workers, and the resource tracker of multiprocessing.
        assert len(processes_of_session(parent.pid)) >= 3
        parent.send_signal(number)
        parent.wait(SECONDS_TO_END_MAX)
        wait_until(lambda: not processes_of_session(parent.pid), SECONDS_TO_END_MAX, "no worker")
    finally:
        parent.kill()
        parent.wait()
        for worker in processes_of_session(parent.pid):
            os.kill(worker, signal.SIGKILL)
    for path in folder.iterdir():
        assert path.suffix in (".npz", ".failed", ".partial")
        if path.suffix == ".npz":
            with np.load(path) as episode:
                assert len(episode["image"]) == len(episode["state"]) > 0
