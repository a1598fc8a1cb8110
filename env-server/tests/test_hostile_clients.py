"""What one client does wrong costs the others of a server nothing, with real processes.

The same for the native server, where the tests are told its program in REVER_SIMULATOR.
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from conftest import free_endpoint

import rever_env
from rever_env import protocol
from rever_env.serving import Endpoints

KEYS = protocol.Keys("local")
WAIT_SECS = 60.0
PAUSE_SECS_MAX = 6.0  # for others: zenoh waits a minute for a peer that stops reading
GROWTH_BYTES_MAX = 300 << 20
MOTION = np.array([0.01, 0.0, -0.01, 0.0, 0.0, 0.0, -1.0], np.float32)
SERVERS = {"python": [sys.executable, "-m", "rever_env"]}
if "REVER_SIMULATOR" in os.environ:
    SERVERS["native"] = [os.environ["REVER_SIMULATOR"]]


@pytest.fixture(params=SERVERS)
def served(request: pytest.FixtureRequest) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """The endpoint of a server, and its process."""
    endpoint = free_endpoint()
    with subprocess.Popen(
        [*SERVERS[request.param], "serve", "--listen", endpoint, "--sessions", "8"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready ")
        yield endpoint, process
        process.kill()


@contextlib.contextmanager
def doing(deed: str, endpoint: str, until: str = "done") -> Iterator["subprocess.Popen[str]"]:
    """A hostile client that has done its deed, or has begun with it."""
    script = Path(__file__).with_name("hostile_client.py")
    with subprocess.Popen(
        [sys.executable, str(script), endpoint, deed], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == f"{until}\n"
            yield process
        finally:
            process.kill()


class Beats:
    """When heartbeats of the servers at an endpoint came."""

    def __init__(self, endpoint: str) -> None:
        configuration = Endpoints((endpoint,), (), multicast=False).configuration()
        self._network = zenoh.open(zenoh.Config.from_json5(configuration))
        self._times = [time.monotonic()]
        self._came = threading.Event()
        self._subscriber = self._network.declare_subscriber(
            "rever/*/local/server/*/heartbeat", self._on_beat
        )
        assert self._came.wait(WAIT_SECS)

    def _on_beat(self, _: Any) -> None:
        self._times.append(time.monotonic())
        self._came.set()

    def longest_pause(self) -> float:
        """Until now; no more is counted."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._network.close()  # type: ignore[no-untyped-call]
        return float(np.diff([*self._times, time.monotonic()]).max())


class Honest:
    """A client that does an episode and remembers its longest wait."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
        self._remote = self._opened()
        self.longest_wait = 0.0

    def _opened(self) -> Any:
        return rever_env.RemoteEnv(
            self._endpoint,
            "widowx_stack_cube",
            image_height=64,
            image_width=64,
            reply_secs=2.0 * WAIT_SECS,
        )

    def episode(self, steps: int = 40) -> list[bytes]:
        """What is seen at the start and after each step."""
        seen = [self._timed(lambda: self._remote.reset(seed=5))[0]]
        seen += [self._timed(lambda: self._remote.step(MOTION))[0] for _ in range(steps)]
        return [one["image"].tobytes() + one["state"].tobytes() for one in seen]

    def another(self) -> None:
        """Opens a session and closes it."""
        self._timed(self._opened).close()

    def close(self) -> None:
        self._remote.close()

    def _timed(self, act: Any) -> Any:
        begun = time.monotonic()
        result = act()
        self.longest_wait = max(self.longest_wait, time.monotonic() - begun)
        return result


def resident_bytes(process: "subprocess.Popen[str]") -> int:
    pages = Path(f"/proc/{process.pid}/statm").read_text(encoding="ascii").split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize(
    ("deed", "until"),
    [
        ("stop_reading_replies", "done"),
        ("stop_reading_answers", "done"),
        ("tiny_messages", "done"),
        ("flood_own_session", "begun"),
        ("large_messages", "done"),
    ],
)
def test_other_clients_go_on_undisturbed(
    served: tuple[str, "subprocess.Popen[str]"], deed: str, until: str
) -> None:
    endpoint, process = served
    honest = Honest(endpoint)
    expected = honest.episode()
    honest.longest_wait = 0.0
    memory = resident_bytes(process)
    beats = Beats(endpoint)
    with doing(deed, endpoint, until):
        assert honest.episode() == expected
        honest.another()
        assert honest.longest_wait < PAUSE_SECS_MAX
        assert beats.longest_pause() < PAUSE_SECS_MAX
        assert resident_bytes(process) - memory < GROWTH_BYTES_MAX
    honest.close()


def test_a_server_ends_though_a_client_reads_nothing(
    served: tuple[str, "subprocess.Popen[str]"],
) -> None:
    endpoint, process = served
    with doing("stop_reading_replies", endpoint):
        Honest(endpoint).episode(steps=2)  # so that the deed has arrived
        process.send_signal(signal.SIGTERM)
        assert process.wait(WAIT_SECS) == 0
