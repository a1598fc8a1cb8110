"""Sessions over zenoh, all stepped by one thread: the one that owns the rendering contexts.

zenoh's threads only enqueue: callback -> bounded queue -> simulation thread -> session -> reply.
"""

import logging
import os
import queue
import secrets
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Literal

import mujoco
import zenoh

from rever_env import protocol
from rever_env.fault import Fault
from rever_env.protocol import limits
from rever_env.session import Session, refused
from rever_env.worlds import UnknownTask, Worlds

_log = logging.getLogger(__name__)

_BEAT_SECS = 0.5
_HOLDER_SECS_MAX = 10.0  # from opening a session to its holder's token
_CLOSED_SECS_MAX = 10.0  # a closed session still answers: its last reply may have been lost
_PENDING_PER_SESSION_MAX = 4  # requests waiting in the queue; the holder resends what is dropped


@dataclass(frozen=True)
class ServerOptions:
    """fleet: who meets whom; idle_secs_max: a session without requests ends after that."""

    fleet: str = "local"
    sessions_max: int = 16
    idle_secs_max: int = 600


@dataclass
class _Lease:
    """A session with what zenoh holds for it.

    zenoh's threads write used_at and holder at once: a simulation thread that was busy for long
    must not take what waits in its queue for silence.
    """

    session: Session
    publisher: Any
    declared: list[Any]
    opened_at: float
    used_at: float
    holder: Literal["awaited", "alive", "gone"] = "awaited"

    def on_token(self, sample: Any) -> None:
        """The holder's liveliness token came or went."""
        if sample.kind == zenoh.SampleKind.PUT:
            self.holder = "alive"
        elif self.holder == "alive":
            self.holder = "gone"


class Server:
    """run() serves until stop is set, in the thread that calls it.

    ValueError for options or worlds that the protocol has no room for.
    """

    def __init__(self, network: zenoh.Session, worlds: Worlds, options: ServerOptions) -> None:
        if not 1 <= options.sessions_max <= limits.SESSIONS_MAX:
            raise ValueError(
                f"sessions: expected 1 to {limits.SESSIONS_MAX}, got {options.sessions_max}"
            )
        self.id = secrets.token_hex(8)
        self._network = network
        self._worlds = worlds
        self._options = options
        self._keys = protocol.Keys(options.fleet)
        self._leases: dict[str, _Lease] = {}
        self._ended_steps = 0
        # The simple queue wakes its reader faster than the bounded one; the callback bounds it.
        self._work: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._work_max = (options.sessions_max + 1) * _PENDING_PER_SESSION_MAX
        self._description()  # worlds that cannot be described are refused now

    def run(self, stop: threading.Event, ready: Callable[[str], None]) -> None:
        """Declares everything, the liveliness token last; then works until stop is set."""
        declared: list[Any] = [
            self._network.declare_queryable(
                self._keys.describe(self.id), _direct(self._enqueuing(self._describe))
            ),
            self._network.declare_queryable(
                self._keys.open(self.id), _direct(self._enqueuing(self._open))
            ),
        ]
        heartbeat = self._network.declare_publisher(
            self._keys.heartbeat(self.id),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
        )
        declared.append(heartbeat)
        declared.append(self._network.liveliness().declare_token(self._keys.server(self.id)))
        ready(self.id)
        try:
            self._loop(stop, heartbeat)
        finally:
            for declaration in reversed(declared):
                declaration.undeclare()
            for name in list(self._leases):
                self._end(name, None)
            self._worlds.close()

    def _loop(self, stop: threading.Event, heartbeat: Any) -> None:
        beat_at = time.monotonic()
        while not stop.is_set():
            now = time.monotonic()
            if now >= beat_at:
                heartbeat.put(protocol.HEARTBEAT.encode(self._heartbeat()))
                self._end_abandoned(now)
                beat_at = now + _BEAT_SECS
            try:
                work = self._work.get(timeout=max(beat_at - now, 0.001))
            except queue.Empty:
                continue
            work()

    def _enqueuing(self, act: Callable[[Any], None]) -> Callable[[Any], None]:
        """A callback that leaves act to the simulation thread and drops what is too much."""

        def callback(event: Any) -> None:
            if self._work.qsize() < self._work_max:
                self._work.put(lambda: act(event))
            else:
                _log.warning("more is asked than %d waiting requests", self._work_max)

        return callback

    def _describe(self, query: Any) -> None:
        with query:
            query.reply(self._keys.describe(self.id), self._description())

    def _description(self) -> bytes:
        description = protocol.Description(
            protocol=protocol.PROTOCOL_VERSION,
            server=self.id,
            simulator=self._worlds.simulator,
            simulator_version=f"{metadata_version()} mujoco {mujoco.__version__}",
            tasks=tuple(
                protocol.TaskDescription(
                    task=task.name,
                    variant=task.variant,
                    version=task.version,
                    instruction=task.instruction,
                    steps_max=task.steps_max,
                    configurations=len(task.configurations),
                    state=task.state,
                    action=task.action,
                )
                for task in self._worlds.tasks.values()
            ),
            image_side_max=self._worlds.image_side_max,
            sessions=self._sessions(),
            sessions_max=self._options.sessions_max,
            slots_max=limits.SLOTS_MAX,
            idle_secs_max=self._options.idle_secs_max,
        )
        return protocol.DESCRIPTION.encode(description)

    def _open(self, query: Any) -> None:
        answer: protocol.Opened | protocol.OpenRefused
        try:
            size = 0 if query.payload is None else len(query.payload)
            protocol.OPEN.check_size(size)
            opened = protocol.OPEN.decode(query.payload.to_bytes() if size else b"")
            if self._sessions() >= self._options.sessions_max:
                raise ValueError(f"all {self._options.sessions_max} sessions are in use")
            answer = protocol.Opened(self._lease(opened))
        except (ValueError, UnknownTask, Fault) as error:
            answer = protocol.OpenRefused(str(error)[:200])
        with query:
            query.reply(self._keys.open(self.id), protocol.OPENING.encode(answer))

    def _lease(self, opened: protocol.Open) -> str:
        """A new session; everything that hears its requests stands when this returns."""
        session = Session(opened, self._worlds)
        name = secrets.token_hex(8)
        publisher = self._network.declare_publisher(
            self._keys.reply(name),
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
            express=True,
        )
        now = time.monotonic()
        lease = _Lease(session, publisher, [publisher], opened_at=now, used_at=now)
        self._leases[name] = lease
        enqueue = self._enqueuing(lambda sample: self._answer(name, sample))

        def on_request(sample: Any) -> None:
            lease.used_at = time.monotonic()
            enqueue(sample)

        look = self._enqueuing(lambda _: self._end_abandoned(time.monotonic()))

        def on_token(sample: Any) -> None:
            lease.on_token(sample)
            if lease.holder == "gone":
                look(sample)  # at once, or with the next heartbeat if the queue is full

        lease.declared.append(
            self._network.declare_subscriber(self._keys.request(name), _direct(on_request))
        )
        lease.declared.append(
            self._network.liveliness().declare_subscriber(
                self._keys.session(name), _direct(on_token), history=True
            )
        )
        _log.info("session %s opened for %s", name, opened.holder)
        return name

    def _answer(self, name: str, sample: Any) -> None:
        lease = self._leases.get(name)
        if lease is None:
            return
        try:
            protocol.REQUEST.check_size(len(sample.payload))
        except protocol.TooLarge as error:
            lease.publisher.put(refused(0, str(error)))
            return
        reply = lease.session.answer(sample.payload.to_bytes())
        if reply is not None:
            lease.publisher.put(reply)
        # However long that took, its holder was not the silent one.
        lease.used_at = time.monotonic()

    def _end_abandoned(self, now: float) -> None:
        for name, lease in list(self._leases.items()):
            if lease.session.closed and now - lease.used_at > _CLOSED_SECS_MAX:
                self._end(name, None)
            elif lease.holder == "gone":
                self._end(name, "its holder is gone")
            elif lease.holder == "awaited" and now - lease.opened_at > _HOLDER_SECS_MAX:
                self._end(name, f"expected its holder's token within {_HOLDER_SECS_MAX:.0f} s")
            elif now - lease.used_at > self._options.idle_secs_max:
                self._end(name, f"no request came for {self._options.idle_secs_max} s")

    def _end(self, name: str, reason: str | None) -> None:
        lease = self._leases.pop(name)
        self._ended_steps += lease.session.steps
        if reason is not None:
            _log.info("session %s ended: %s", name, reason)
            lease.publisher.put(refused(0, f"session {name} ended: {reason}"))
        for declaration in reversed(lease.declared):
            declaration.undeclare()
        lease.session.end()

    def _heartbeat(self) -> protocol.Heartbeat:
        steps = self._ended_steps + sum(lease.session.steps for lease in self._leases.values())
        return protocol.Heartbeat(self.id, self._sessions(), steps, resident_bytes())

    def _sessions(self) -> int:
        """Sessions in use."""
        return sum(not lease.session.closed for lease in self._leases.values())


def _direct(callback: Callable[[Any], None]) -> Any:
    """Called by zenoh's own thread: a thread between the two would cost a switch per request."""
    return zenoh.handlers.Callback(callback, indirect=False)


def resident_bytes() -> int:
    """Memory that this process holds; its peak where the system does not tell the present."""
    if sys.platform == "linux":
        with open("/proc/self/statm", "rb") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def metadata_version() -> str:
    """This package's version; a checkout that is not installed says so."""
    try:
        return metadata.version("rever_env")
    except metadata.PackageNotFoundError:
        return "checkout"
