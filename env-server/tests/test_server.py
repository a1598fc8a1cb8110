"""Sessions and the serving process, with real worlds and real sockets."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from conftest import free_endpoint

from rever_env import protocol, tasks, world
from rever_env.protocol import tiles
from rever_env.server import Server, ServerOptions
from rever_env.serving import Endpoints
from rever_env.session import Session
from rever_env.tasks import TaskId
from rever_env.worlds import UnknownTask, Worlds

SPOON = "widowx_spoon_on_towel"
CUBE = "widowx_stack_cube"
OPEN = protocol.Open(protocol.PROTOCOL_VERSION, SPOON, "default", 64, 64, True, "test")
STILL = (0.0,) * 7
WAIT_SECS = 60.0


@pytest.fixture
def worlds() -> Iterator[Worlds]:
    """Worlds in this thread."""
    worlds = Worlds(tasks.load(), idle_max=4)
    yield worlds
    worlds.close()


@pytest.fixture
def session(worlds: Worlds) -> Iterator[Session]:
    """A session in the middle of its first episode: requests 1 and 2 are answered."""
    session = Session(OPEN, worlds)
    assert isinstance(ask(session, protocol.Reset(1, SPOON, "default", 3, 7)), protocol.Observed)
    assert isinstance(ask(session, protocol.Step(2, STILL)), protocol.Stepped)
    yield session
    session.end()


def ask(session: Session, request: protocol.Request) -> protocol.Reply:
    """The reply; there must be one."""
    data = session.answer(protocol.REQUEST.encode(request))
    assert data is not None
    return protocol.REPLY.decode(data)


def check_refused(reply: protocol.Reply, sequence: int, words: str) -> None:
    """The reply must be a refusal with these words."""
    assert isinstance(reply, protocol.Refused)
    assert reply.sequence == sequence
    assert words in reply.reason


def test_the_same_number_again_gives_the_same_bytes_and_no_step(session: Session) -> None:
    request = protocol.REQUEST.encode(protocol.Step(3, (0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)))
    first = session.answer(request)
    steps = session.steps
    assert session.answer(request) == first
    assert session.steps == steps == 2


def test_a_lower_number_is_dropped(session: Session) -> None:
    assert session.answer(protocol.REQUEST.encode(protocol.Step(1, STILL))) is None


def test_a_gap_is_refused_and_uses_no_number_up(session: Session) -> None:
    check_refused(ask(session, protocol.Step(4, STILL)), 4, "sequence: expected 3, got 4")
    assert isinstance(ask(session, protocol.Step(3, STILL)), protocol.Stepped)


def test_an_invalid_request_uses_its_number_up(session: Session) -> None:
    step = protocol.REQUEST.encode(protocol.Step(3, (0.25,) * 7))
    broken = step.replace(b"\xca\x3e\x80\x00\x00", b"\xca\x7f\xc0\x00\x00", 1)
    for _ in range(2):
        data = session.answer(broken)
        assert data is not None
        check_refused(protocol.REPLY.decode(data), 3, "expected finite numbers, got nan")
    assert isinstance(ask(session, protocol.Step(4, STILL)), protocol.Stepped)


def test_what_cannot_be_read_is_refused_without_a_number(session: Session) -> None:
    data = session.answer(b"\xc1")
    assert data is not None
    check_refused(protocol.REPLY.decode(data), 0, "request cannot be read")
    assert isinstance(ask(session, protocol.Step(3, STILL)), protocol.Stepped)


def test_a_step_without_an_episode_is_refused(worlds: Worlds) -> None:
    session = Session(OPEN, worlds)
    check_refused(ask(session, protocol.Step(1, STILL)), 1, "expected Reset first, got Step")
    session.end()


def test_a_step_beyond_the_horizon_is_refused(session: Session, worlds: Worlds) -> None:
    steps_max = worlds.task(SPOON, "default").steps_max
    for number in range(3, steps_max + 2):
        reply = ask(session, protocol.Step(number, STILL))
        assert isinstance(reply, protocol.Stepped)
        assert reply.transition.truncated == (number == steps_max + 1)
    reply = ask(session, protocol.Step(steps_max + 2, STILL))
    check_refused(reply, steps_max + 2, f"expected at most {steps_max}")


def test_slots_last_until_the_next_reset(session: Session) -> None:
    check_refused(ask(session, protocol.Restore(3, 1)), 3, "slot: expected one of [], got 1")
    assert ask(session, protocol.Save(4, 1)) == protocol.Saved(4)
    stepped = ask(session, protocol.Step(5, STILL))
    restored = ask(session, protocol.Restore(6, 1))
    again = ask(session, protocol.Step(7, STILL))
    assert isinstance(restored, protocol.Restored)
    assert isinstance(stepped, protocol.Stepped) and isinstance(again, protocol.Stepped)
    assert stepped.transition == again.transition
    assert isinstance(ask(session, protocol.Reset(8, SPOON, "default", 3, 7)), protocol.Observed)
    check_refused(ask(session, protocol.Restore(9, 1)), 9, "slot: expected one of [], got 1")


def test_a_refused_reset_of_another_task_changes_nothing(session: Session, worlds: Worlds) -> None:
    other = Session(OPEN, worlds)
    ask(other, protocol.Reset(1, CUBE, "default", 3, 7))
    other.end()  # its world waits in the middle of an episode
    ask(session, protocol.Save(3, 1))
    stepped = ask(session, protocol.Step(4, STILL))
    ask(session, protocol.Restore(5, 1))
    check_refused(ask(session, protocol.Reset(6, CUBE, "default", 999, 7)), 6, "layout")
    again = ask(session, protocol.Step(7, STILL))
    assert isinstance(stepped, protocol.Stepped) and isinstance(again, protocol.Stepped)
    assert stepped.transition == again.transition
    assert isinstance(ask(session, protocol.Restore(8, 1)), protocol.Restored)


def test_a_step_brings_the_tiles_that_changed_or_all_of_them(worlds: Worlds) -> None:
    brought = []
    for whole_images in (False, True):
        session = Session(OPEN, worlds, whole_images=whole_images)
        observed = ask(session, protocol.Reset(1, SPOON, "default", 3, 7))
        stepped = ask(session, protocol.Step(2, (0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)))
        session.end()
        assert isinstance(observed, protocol.Observed) and isinstance(stepped, protocol.Stepped)
        brought.append((observed.observation.image, stepped))
    (first, parts), (_, whole) = brought
    assert whole.changed_tiles is None
    assert parts.changed_tiles is not None and 0 < len(parts.changed_tiles) <= 8  # of 16
    image = parts.transition.observation.image
    assert tiles.complete(image, parts.changed_tiles, first) == whole.transition.observation.image


def test_a_world_that_served_others_gives_the_same_bytes(session: Session, worlds: Worlds) -> None:
    fresh = ask(session, protocol.Reset(3, CUBE, "default", None, 99))
    for number in range(4, 9):
        ask(session, protocol.Step(number, (0.02, 0.01, -0.02, 0.0, 0.0, 0.2, -1.0)))
    session.end()
    second = Session(OPEN, worlds)
    used = ask(second, protocol.Reset(1, CUBE, "default", None, 99))
    assert isinstance(fresh, protocol.Observed) and isinstance(used, protocol.Observed)
    assert fresh.observation == used.observation
    second.end()


def test_a_closed_session_repeats_its_last_reply_and_does_nothing_else(session: Session) -> None:
    close = protocol.REQUEST.encode(protocol.Close(3))
    first = session.answer(close)
    assert first == protocol.REPLY.encode(protocol.Closed(3))
    assert session.answer(close) == first
    reply = ask(session, protocol.Reset(4, SPOON, "default", 3, 7))
    check_refused(reply, 4, "expected nothing after Close, got Reset")


def test_unknown_tasks_and_placements_are_refused(session: Session, worlds: Worlds) -> None:
    reply = ask(session, protocol.Reset(3, "widowx_fold_towel", "default", None, 7))
    check_refused(reply, 3, "task widowx_fold_towel: expected one of widowx_spoon_on_towel, ")
    reply = ask(session, protocol.Reset(4, SPOON, "upside-down", None, 7))
    check_refused(reply, 4, f"task {SPOON}/upside-down: expected one of {SPOON}, {SPOON}/paraph")
    reply = ask(session, protocol.Reset(5, SPOON, "default", 24, 7))
    assert isinstance(reply, protocol.Refused)
    with pytest.raises(UnknownTask, match="task widowx_fold_towel: expected"):
        Session(
            protocol.Open(
                protocol.PROTOCOL_VERSION, "widowx_fold_towel", "default", 64, 64, False, "test"
            ),
            worlds,
        )


def test_a_broken_world_is_a_fault_until_the_next_reset(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverge(*_: Any) -> None:
        raise world.PhysicsDiverged("expected finite speeds, got nan")

    with monkeypatch.context() as patch:
        patch.setattr(world.World, "_advance", diverge)
        reply = ask(session, protocol.Step(3, STILL))
    assert isinstance(reply, protocol.Faulted)
    assert reply.kind is protocol.FaultKind.PHYSICS_DIVERGED
    check_refused(ask(session, protocol.Step(4, STILL)), 4, "expected Reset first")
    assert isinstance(ask(session, protocol.Reset(5, SPOON, "default", 3, 7)), protocol.Observed)


def test_a_defect_is_a_fault_and_not_an_outcome(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        raise ZeroDivisionError("x" * 5000)

    monkeypatch.setattr(world.World, "_advance", fail)
    reply = ask(session, protocol.Step(3, STILL))
    assert isinstance(reply, protocol.Faulted)
    assert reply.kind is protocol.FaultKind.INTERNAL
    assert reply.reason.startswith("ZeroDivisionError: xxx")


def test_the_expert_speaks_only_when_asked(worlds: Worlds) -> None:
    for expert in (False, True):
        opened = protocol.Open(protocol.PROTOCOL_VERSION, SPOON, "default", 64, 64, expert, "test")
        session = Session(opened, worlds)
        reply = ask(session, protocol.Reset(1, SPOON, "default", 3, 7))
        assert isinstance(reply, protocol.Observed)
        assert (reply.observation.expert_action is not None) == expert
        assert reply.observation.image.pixels != bytes(64 * 64 * 3)
        assert np.isfinite(reply.observation.state).all()
        session.end()


def test_idle_worlds_are_limited() -> None:
    class Probe(world.World):
        def __init__(self, task: tasks.Task, height: int, width: int) -> None:
            self.closed = False

        def close(self) -> None:
            self.closed = True

    worlds = Worlds(tasks.load(), idle_max=2, make=Probe)
    key = (SPOON, "default", 64, 64)
    taken = [worlds.take(key) for _ in range(3)]
    for taken_world in taken:
        worlds.give_back(key, taken_world)
    assert [probe.closed for probe in taken if isinstance(probe, Probe)] == [True, False, False]
    assert worlds.take(key) is taken[1]


@contextlib.contextmanager
def serve(
    endpoint: str, *arguments: str, launcher: tuple[str, ...] = ()
) -> Iterator[subprocess.Popen[str]]:
    """A serving process that has said nothing yet; a test that fails ends it."""
    command = [sys.executable, "-m", "rever_env", "serve", "--listen", endpoint, *arguments]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])}
    with subprocess.Popen(
        [*launcher, *command], stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def first_line(process: subprocess.Popen[str]) -> str:
    """What the process says first; the test's own limit bounds the wait."""
    assert process.stdout is not None
    return process.stdout.readline()


@pytest.mark.parametrize(
    ("names", "offered"),
    [
        ([], [str(task.id) for task in tasks.load().values()]),
        (
            ["widowx_stack_cube", "widowx_carrot_on_plate/all"],
            ["widowx_carrot_on_plate", "widowx_carrot_on_plate/size-0.5", "widowx_stack_cube"],
        ),
    ],
    ids=["all", "some"],
)
def test_a_server_describes_itself_and_ends_on_a_signal(
    names: list[str], offered: list[str]
) -> None:
    endpoint = free_endpoint()
    chosen = ["--tasks", *names] if names else []
    with serve(endpoint, "--sessions", "3", "--fleet", "home", *chosen) as process:
        ready = first_line(process)
        assert ready.startswith("ready ")
        name = ready.split()[1]
        settings = Endpoints((endpoint,), (), False).configuration()
        with zenoh.open(zenoh.Config.from_json5(settings)) as network:
            for reply in network.get(protocol.Keys("home").describe(name), timeout=WAIT_SECS):
                description = protocol.DESCRIPTION.decode(reply.ok.payload.to_bytes())
        assert (description.server, description.sessions_max) == (name, 3)
        described = [str(TaskId(task.task, task.variant)) for task in description.tasks]
        assert described == offered
        process.send_signal(signal.SIGTERM)
        assert process.wait(WAIT_SECS) == 0


def started(thread: threading.Thread) -> Callable[[str], None]:
    """Starts the thread when the server is ready."""
    return lambda _: thread.start()


def test_a_network_can_be_closed_after_a_server_that_was_being_asked(worlds: Worlds) -> None:
    endpoint = free_endpoint()
    here = Endpoints((), (endpoint,), False).configuration()
    there = Endpoints((endpoint,), (), False).configuration()
    with zenoh.open(zenoh.Config.from_json5(here)) as asker:
        for _ in range(20):
            stop = threading.Event()

            def ask_on(name: str, stop: threading.Event = stop) -> None:
                for count in range(500):
                    asker.get(protocol.Keys("local").describe(name), timeout=WAIT_SECS)
                    if count == 100:
                        stop.set()

            # zenoh refuses to close what another thread still uses.
            with zenoh.open(zenoh.Config.from_json5(there)) as network:
                server = Server(network, worlds, ServerOptions())
                thread = threading.Thread(target=ask_on, args=(server.id,))
                server.run(stop, started(thread))
            thread.join()


def test_a_server_ends_with_its_parent() -> None:
    program = "import subprocess, sys; subprocess.run(sys.argv[1:])"
    launcher = (sys.executable, "-c", program)
    with serve(free_endpoint(), "--exit-with-parent", launcher=launcher) as parent:
        assert first_line(parent).startswith("ready ")
        parent.kill()
        assert parent.stdout is not None
        # The server holds the other end of this pipe: it closes when the server ends.
        assert parent.stdout.read() == ""


def test_a_server_without_a_network_is_wrong_usage() -> None:
    command = [sys.executable, "-m", "rever_env", "serve"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_SECS)
    assert done.returncode == 2
    assert "expected --connect, --listen or --multicast, got none" in done.stderr


def test_nothing_listens_but_what_is_named() -> None:
    configuration = json.loads(Endpoints(("tcp/127.0.0.1:1",), (), False).configuration())
    assert configuration["listen"]["endpoints"] == []
    assert not configuration["scouting"]["multicast"]["enabled"]
    assert not configuration["scouting"]["gossip"]["enabled"]
    assert "listen" not in json.loads(Endpoints((), (), True).configuration())


def test_only_one_way_out_and_no_way_in_makes_a_client() -> None:
    def mode(connect: tuple[str, ...], listen: tuple[str, ...]) -> object:
        return json.loads(Endpoints(connect, listen, False).configuration())["mode"]

    first, second = "tcp/127.0.0.1:1", "tcp/127.0.0.1:2"
    assert mode((first,), ()) == "client"
    assert mode((first, second), ()) == "peer"
    assert mode((first,), (second,)) == "peer"


def test_the_file_system_alone_is_local() -> None:
    socket, loopback = "unixsock-stream//tmp/a", "tcp/127.0.0.1:1"
    assert Endpoints((socket,), (), multicast=False).are_local
    assert Endpoints((), (socket,), multicast=False).are_local
    assert not Endpoints((socket,), (loopback,), multicast=False).are_local
    assert not Endpoints((loopback,), (), multicast=False).are_local
    assert not Endpoints((socket,), (), multicast=True).are_local
