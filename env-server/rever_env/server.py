"""Sessions over zenoh, all stepped by one thread: the one that owns the rendering contexts.

It waits for requests in zenoh's own channel: request -> inbox -> simulation thread -> session ->
reply. All else that it has to do waits in a queue, and a message to the inbox says so: waking it by
Python's locks would cost each request another switch of threads.
"""

import collections
import contextlib
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
_PENDING_PER_SESSION_MAX = 4  # requests in the inbox; the holder resends what is dropped
_TICK, _WORK = "tick", "work"  # messages of our own to the inbox


@dataclass(frozen=True)
class ServerOptions:
    """fleet: who meets whom.

    whole_images: a step's image is not compared with the last one to send what changed only. Where
    nothing leaves the machine comparing takes longer than it spares.
    """

    fleet: str = "local"
    sessions_max: int = 16
    whole_images: bool = False


@dataclass
class _Lease:
    """A session with what zenoh holds for it. zenoh's threads write holder."""

    name: str
    session: Session
    publisher: Any
    key: zenoh.KeyExpr
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
        self._leases: dict[str, _Lease] = {}  # by the key of its requests
        self._tick_key = self._keys.request(self._named(_TICK))
        self._ended_steps = 0
        self._pending_max = (options.sessions_max + 1) * _PENDING_PER_SESSION_MAX
        self._work: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._ticks: collections.deque[float] = collections.deque(maxlen=self._pending_max)
        self._waking = threading.Lock()
        self._ended = False  # set under _waking: zenoh refuses to be closed while a thread puts
        self._description()  # worlds that cannot be described are refused now

    def run(self, stop: threading.Event, ready: Callable[[str], None]) -> None:
        """Declares everything, the liveliness token last; then works until stop is set."""
        inbox = self._network.declare_subscriber(
            self._keys.requests(self.id), zenoh.handlers.RingChannel(self._pending_max)
        )
        declared: list[Any] = [
            inbox,
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
        threading.Thread(target=self._tick, args=(stop,), name="clock", daemon=True).start()
        try:
            self._loop(stop, inbox, heartbeat)
        finally:
            with self._waking:
                self._ended = True
            for declaration in reversed(declared):
                declaration.undeclare()
            for key in list(self._leases):
                self._end(key, None)
            self._worlds.close()

    def _loop(self, stop: threading.Event, inbox: Any, heartbeat: Any) -> None:
        beat_at = time.monotonic()
        while not stop.is_set():
            sample = inbox.recv()
            key = str(sample.key_expr)
            lease = self._leases.get(key)
            if lease is not None:
                self._answer(lease, sample.payload)
                continue
            with contextlib.suppress(queue.Empty):
                while True:
                    self._work.get_nowait()()
            if key == self._tick_key and self._ticks:
                self._end_abandoned(self._ticks.popleft())
                if time.monotonic() >= beat_at:
                    heartbeat.put(protocol.HEARTBEAT.encode(self._heartbeat()))
                    beat_at = time.monotonic() + _BEAT_SECS / 2

    def _tick(self, stop: threading.Event) -> None:
        """Tells the simulation thread that time passes, and at once when stop is set."""
        stopped = False
        while not stopped:
            stopped = stop.wait(_BEAT_SECS)
            if self._ended:
                return
            self._ticks.append(time.monotonic())
            self._wake(_TICK)

    def _wake(self, kind: str) -> None:
        """Puts a message of our own behind the requests in the inbox."""
        with self._waking, contextlib.suppress(zenoh.ZError):  # a closed network: nobody waits
            if not self._ended:
                self._network.put(
                    self._keys.request(self._named(kind)),
                    b"",
                    allowed_destination=zenoh.Locality.SESSION_LOCAL,
                )

    def _named(self, name: str) -> str:
        """What the inbox takes for one of this server's sessions."""
        return f"{self.id}.{name}"

    def _enqueuing(self, act: Callable[[Any], None]) -> Callable[[Any], None]:
        """A callback that leaves act to the simulation thread and drops what is too much."""

        def callback(event: Any) -> None:
            if self._work.qsize() < self._pending_max:
                self._work.put(lambda: act(event))
                self._wake(_WORK)
            else:
                _log.warning("more is asked than %d waiting requests", self._pending_max)

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
                    control_hz=task.control_hz,
                    layouts=len(task.layouts),
                    state=task.state,
                    action=task.action,
                )
                for task in self._worlds.tasks.values()
            ),
            image_side_max=self._worlds.image_side_max,
            sessions=self._sessions(),
            sessions_max=self._options.sessions_max,
            slots_max=limits.SLOTS_MAX,
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
        session = Session(opened, self._worlds, whole_images=self._options.whole_images)
        name = self._named(secrets.token_hex(8))
        publisher = self._network.declare_publisher(
            self._keys.reply(name),
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
            express=True,
        )
        # zenoh knows the key by a number then, and need not match each request with the inbox.
        key = self._network.declare_keyexpr(self._keys.request(name))
        now = time.monotonic()
        lease = _Lease(name, session, publisher, key, [publisher], opened_at=now, used_at=now)
        self._leases[str(key)] = lease
        look = self._enqueuing(lambda _: self._end_gone())

        def on_token(sample: Any) -> None:
            lease.on_token(sample)
            if lease.holder == "gone":
                look(sample)  # at once, or with the next tick if the queue is full

        lease.declared.append(
            self._network.liveliness().declare_subscriber(
                self._keys.session(name), _direct(on_token), history=True
            )
        )
        _log.info("session %s opened for %s", name, opened.holder)
        return name

    def _answer(self, lease: _Lease, payload: zenoh.ZBytes) -> None:
        reply = lease.session.answer(payload.to_bytes())
        if reply is not None:
            lease.publisher.put(reply)
        # However long that took, its holder was not the silent one.
        lease.used_at = time.monotonic()

    def _end_gone(self) -> None:
        for key, lease in list(self._leases.items()):
            if lease.holder == "gone":
                self._end(key, "its holder is gone")

    def _end_abandoned(self, as_of: float) -> None:
        """Ends what nobody used until then; what came later may still wait in the inbox."""
        self._end_gone()
        for key, lease in list(self._leases.items()):
            if lease.session.closed and as_of - lease.used_at > _CLOSED_SECS_MAX:
                self._end(key, None)
            elif lease.holder == "awaited" and as_of - lease.opened_at > _HOLDER_SECS_MAX:
                self._end(key, f"expected its holder's token within {_HOLDER_SECS_MAX:.0f} s")

    def _end(self, key: str, reason: str | None) -> None:
        lease = self._leases.pop(key)
        self._ended_steps += lease.session.steps
        if reason is not None:
            _log.info("session %s ended: %s", lease.name, reason)
            lease.publisher.put(refused(0, f"session {lease.name} ended: {reason}"))
        for declaration in reversed(lease.declared):
            declaration.undeclare()
        self._network.undeclare(lease.key)
        lease.session.end()

    def _heartbeat(self) -> protocol.Heartbeat:
        steps = self._ended_steps + sum(lease.session.steps for lease in self._leases.values())
        return protocol.Heartbeat(self.id, self._sessions(), steps, resident_bytes())

    def _sessions(self) -> int:
        """Sessions in use."""
        return sum(not lease.session.closed for lease in self._leases.values())


def _direct(callback: Callable[[Any], None]) -> Any:
    """Called by zenoh's own thread, which a callback that only hands on may hold up."""
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
