"""The environment server: sessions over zenoh, all stepped by the simulation thread.

zenoh callback -> inbox -> simulation thread -> session -> outbox. Neither zenoh's threads nor the
simulation thread block on a peer. The simulation thread owns the rendering contexts.
"""

import contextlib
import logging
import os
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
from rever_env.inbox import Inbox
from rever_env.outbox import Answers, Outbox, size
from rever_env.protocol import limits
from rever_env.session import Session, refused
from rever_env.worlds import UnknownTask, Worlds

_log = logging.getLogger(__name__)

_BEAT_SECS = 0.5
_HOLDER_SECS_MAX = 10.0  # a session outlives its holder's token so long: the link may return
_CLOSED_SECS_MAX = 10.0  # a closed session answers so long: its last reply may have been lost


@dataclass(frozen=True)
class ServerOptions:
    """Options of a server.

    fleet: namespace; peers see each other only within the same fleet.
    sessions_max: maximum number of concurrent sessions.
    whole_images: send whole images instead of changed tiles. Over Unix sockets the comparison of
    images takes longer than it saves.
    """

    fleet: str = "local"
    sessions_max: int = 16
    whole_images: bool = False


@dataclass
class _Lease:
    """A session and its zenoh declarations. zenoh's threads write `holder`."""

    name: str
    opened_for: str
    session: Session
    outbox: Outbox
    opened_at: float
    declared: list[Any]
    closed_at: float | None = None
    holder: Literal["awaited", "alive", "gone"] = "awaited"
    gone_at: float = 0.0

    def on_token(self, sample: Any) -> None:
        """The holder's liveliness token appeared or disappeared."""
        if sample.kind == zenoh.SampleKind.PUT:
            self.holder = "alive"
        elif self.holder == "alive":
            self.gone_at = time.monotonic()
            self.holder = "gone"


class Server:
    """An environment server. run() serves in the calling thread until `stop` is set.

    ValueError for options or worlds beyond the protocol's limits.
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
        self._inbox = Inbox()
        self._answers = Answers()
        self._description()  # raises now for worlds that cannot be described

    def run(self, stop: threading.Event, ready: Callable[[str], None]) -> None:
        """Declares everything, the liveliness token last; serves until `stop` is set."""
        declared: list[Any] = [
            self._queryable(self._keys.describe(self.id), self._describe),
            self._queryable(self._keys.open(self.id), self._open),
        ]
        heartbeat = self._network.declare_publisher(
            self._keys.heartbeat(self.id),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
        )
        declared.append(heartbeat)
        declared.append(self._network.liveliness().declare_token(self._keys.server(self.id)))
        try:
            ready(self.id)
            self._loop(stop, heartbeat)
        finally:
            for declaration in reversed(declared):
                declaration.undeclare()
            for lease in list(self._leases.values()):
                self._end(lease, None)
            self._answers.close()
            self._worlds.close()

    def _loop(self, stop: threading.Event, heartbeat: Any) -> None:
        beat_at = time.monotonic()
        while not stop.is_set():
            now = time.monotonic()
            if now >= beat_at:
                heartbeat.put(protocol.HEARTBEAT.encode(self._heartbeat()))
                self._end_abandoned(now)
                beat_at = now + _BEAT_SECS
            work = self._inbox.take(beat_at)
            if work is not None:
                work()

    def _queryable(self, key: str, answer: Callable[[Any], bytes]) -> Any:
        """Queues the queries on this key for the simulation thread.

        Refuses queries that are too large, and drops queries when the queue is full.
        """

        def on_query(query: Any) -> None:
            try:
                protocol.OPEN.check_size(size(query))
            except protocol.TooLarge as error:
                refusal = protocol.OPENING.encode(protocol.OpenRefused(str(error)))
                self._answers.send(query, key, refusal)
                return
            if not self._inbox.put_query(lambda: self._answers.send(query, key, answer(query))):
                self._answers.discard(query)

        return self._network.declare_queryable(key, _direct(on_query))

    def _describe(self, _query: Any) -> bytes:
        return self._description()

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

    def _open(self, query: Any) -> bytes:
        answer: protocol.Opened | protocol.OpenRefused
        try:
            opened = protocol.OPEN.decode(query.payload.to_bytes() if size(query) else b"")
            if self._sessions() >= self._options.sessions_max:
                raise ValueError(
                    f"all {self._options.sessions_max} sessions are in use, by "
                    + ", ".join(sorted({lease.opened_for for lease in self._leases.values()}))
                )
            answer = protocol.Opened(self._lease(opened))
        except (ValueError, UnknownTask, Fault) as error:
            answer = protocol.OpenRefused(str(error)[:200])
        return protocol.OPENING.encode(answer)

    def _lease(self, opened: protocol.Open) -> str:
        """A new session. Its subscriptions exist when this returns."""
        session = Session(opened, self._worlds, whole_images=self._options.whole_images)
        name = secrets.token_hex(8)
        publisher = self._network.declare_publisher(
            self._keys.reply(name),
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
            express=True,
        )
        lease = _Lease(name, opened.holder, session, Outbox(publisher), time.monotonic(), [])
        self._leases[name] = lease

        lease.declared = [
            self._network.declare_subscriber(
                self._keys.request(name),
                _direct(self._inbox.session(lambda request: self._answer(lease, request))),
            ),
            self._network.liveliness().declare_subscriber(
                self._keys.session(name), _direct(lease.on_token), history=True
            ),
        ]
        _log.info("session %s opened for %s", name, opened.holder)
        return name

    def _answer(self, lease: _Lease, request: bytes | protocol.TooLarge) -> None:
        if lease.name not in self._leases:
            return
        if isinstance(request, protocol.TooLarge):
            reply: bytes | None = refused(0, str(request))
        else:
            reply = lease.session.answer(request)
        if lease.session.closed and lease.closed_at is None:
            lease.closed_at = time.monotonic()
        if reply is not None:
            lease.outbox.send(reply)

    def _end_abandoned(self, now: float) -> None:
        for lease in list(self._leases.values()):
            if lease.closed_at is not None:
                if lease.holder == "gone" or now - lease.closed_at > _CLOSED_SECS_MAX:
                    self._end(lease, None)
            elif lease.holder == "gone" and now - lease.gone_at > _HOLDER_SECS_MAX:
                self._end(lease, f"its client has been gone for {_HOLDER_SECS_MAX:.0f} s")
            elif lease.holder == "awaited" and now - lease.opened_at > _HOLDER_SECS_MAX:
                self._end(
                    lease,
                    f"its client's liveliness token did not appear within {_HOLDER_SECS_MAX:.0f} s",
                )

    def _end(self, lease: _Lease, reason: str | None) -> None:
        del self._leases[lease.name]
        self._ended_steps += lease.session.steps
        if reason is not None:
            _log.info("session %s ended: %s", lease.name, reason)
            lease.outbox.send(refused(0, f"session {lease.name} ended: {reason}"))
        lease.outbox.close()
        for declaration in reversed(lease.declared):
            declaration.undeclare()
        lease.session.end()

    def _heartbeat(self) -> protocol.Heartbeat:
        steps = self._ended_steps + sum(lease.session.steps for lease in self._leases.values())
        return protocol.Heartbeat(self.id, self._sessions(), steps, resident_bytes())

    def _sessions(self) -> int:
        """The number of open sessions."""
        return sum(not lease.session.closed for lease in self._leases.values())


def _direct(callback: Callable[[Any], None]) -> Any:
    """A callback on zenoh's own thread, for callbacks that return at once."""
    return zenoh.handlers.Callback(callback, indirect=False)


def resident_bytes() -> int:
    """Resident memory of this process; its peak on systems that do not report the present."""
    if sys.platform == "linux":
        with open("/proc/self/statm", "rb") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def metadata_version() -> str:
    """The version of the installed package, or of the wheel rever that holds it; or "checkout"."""
    for distribution in ("rever_env", "rever"):
        with contextlib.suppress(metadata.PackageNotFoundError):
            return metadata.version(distribution)
    return "checkout"
