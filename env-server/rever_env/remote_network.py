"""The connection to environment servers: zenoh session, server discovery, loss detection."""

import contextlib
import ctypes
import os
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import zenoh

from rever_env import endpoint, protocol
from rever_env.serving import Endpoints, cause
from rever_env.tasks import TaskId

_LOOK_SECS = 0.2  # between two attempts to find a server
_REFUSED_SECS = 2.0  # timeout while connections are refused
_NOBODY_SECS = 5.0  # timeout while a connection leads to no server
_WAIT_SECS = 30.0  # timeout for a free session, or for a server's reply to a query
_REACH_SECS = 5.0  # timeout of one connection attempt
_RETURN_SECS = 2.0  # from a new connection to the server's liveliness token
_OUTAGE_SECS = 10.0  # a server keeps the session of an absent holder for so long


class RemoteFault(RuntimeError):
    """The environment or the connection to it broke: the episode has no outcome.

    reset() begins a new episode and opens a new session if the old one is lost.
    """


class ForkedProcess(RemoteFault):
    """The process was forked after zenoh was opened; zenoh does not survive a fork."""


class RemoteRefused(ValueError):
    """The server refused a request; its environment is unchanged."""


@dataclass(frozen=True)
class Fleet:
    """The servers to choose from, and timeouts in seconds.

    connect: endpoints of servers or of a router, tcp/HOST:PORT or HOST:PORT.
    fleet: namespace of the servers.
    server: id of one server; None chooses the server with the most free sessions.
    wait_secs: timeout for a free session. None: 2 s while connections are refused (0 s for the
    replacement of a lost session), 5 s while no server is found, 30 s while no session is free.
    reply_secs: timeout for a reply, including the time that a server is paused.
    """

    connect: tuple[str, ...]
    fleet: str = "local"
    server: str | None = None
    wait_secs: float | None = None
    reply_secs: float = 120.0


@dataclass(frozen=True)
class Wanted:
    """The session to open.

    task: TASK or TASK/VARIANT; None for the first task that a server offers.
    variant: None for the variant in task, which is "default" for TASK alone.
    image_height, image_width: pixels; 0 and 0 for no image.
    """

    task: str | None
    variant: str | None
    image_height: int
    image_width: int
    expert: bool

    def among(self, tasks: Sequence[protocol.TaskDescription]) -> protocol.TaskDescription | None:
        """The first of the tasks that fits."""
        for one in tasks:
            if self.variant is None:
                if self.task in (None, str(TaskId(one.task, one.variant))):
                    return one
            elif self.task in (None, one.task) and self.variant == one.variant:
                return one
        return None

    def __str__(self) -> str:
        if self.task is None or self.variant is None:
            return self.task or f"any task in variant {self.variant}"
        return str(TaskId(self.task, self.variant))


class Network:
    """One zenoh session. ForkedProcess in a forked process, in which zenoh does not work.

    is_return: replaces a lost session, so that a refused connection is not retried.
    """

    def __init__(self, fleet: Fleet, *, is_return: bool = False) -> None:
        require_own_process()
        self._fleet = Fleet(**{**vars(fleet), "connect": _checked(fleet.connect)})
        self._keys = protocol.Keys(fleet.fleet)
        self._process = os.getpid()
        if fleet.wait_secs is not None:
            reach_wait = wait = fleet.wait_secs
        else:
            reach_wait, wait = (0.0, _REACH_SECS) if is_return else (_REFUSED_SECS, _WAIT_SECS)
        self._reach(reach_wait)
        configuration = Endpoints(self._fleet.connect, (), multicast=False, wait_secs=wait)
        _first_process.append(self._process)
        try:
            self.zenoh = zenoh.open(zenoh.Config.from_json5(configuration.configuration()))
        except zenoh.ZError as error:
            raise RemoteFault(
                f"no zenoh server or router answered at {self.place} within {wait:g} s: "
                f"{cause(error)}"
            ) from None
        self._is_routed = bool(self.zenoh.info.routers_zid())
        self._declared: list[Any] = []
        self._is_closed = False
        self.is_absent = True  # the server's liveliness token is not there (yet, or any more)
        self._was_seen = False
        self._absent_since = time.monotonic()
        self._connected_since: float | None = None  # while it is absent
        self.restored_at = 0.0  # when the server's token came back, if it ever did
        _open_networks.add(self)

    @property
    def place(self) -> str:
        """The endpoints as text, for messages."""
        return ", ".join(self._fleet.connect)

    @property
    def is_own(self) -> bool:
        """Whether this process opened it; False where it was inherited by a fork."""
        return self._process == os.getpid()

    def declare(self, declared: Any) -> Any:
        """Keeps a zenoh declaration until close."""
        self._declared.append(declared)
        return declared

    def close(self) -> None:
        """Closes the session; does nothing in a forked process, because its parent uses it."""
        if self._is_closed or not self.is_own:
            return
        self._is_closed = True
        for declared in reversed(self._declared):
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()
        with contextlib.suppress(zenoh.ZError):
            self.zenoh.close()  # type: ignore[no-untyped-call]

    def find(self, wanted: "Wanted") -> protocol.Description:
        """The named server, or the one with the most free sessions among those that offer the task.

        RemoteRefused if servers are found and none offers the task.
        """
        fleet = self._fleet
        started = time.monotonic()
        while True:
            found, misread = self._described()
            fitting = [server for server in found if wanted.among(server.tasks)]
            free = [server for server in fitting if server.sessions < server.sessions_max]
            if free:
                return max(free, key=lambda server: server.sessions_max - server.sessions)
            if found and not fitting:
                offered = {
                    TaskId(task.task, task.variant): 0 for one in found for task in one.tasks
                }
                raise RemoteRefused(
                    f"expected one of the tasks {', '.join(map(str, offered))}, got {wanted}"
                )
            default = _WAIT_SECS if found else _NOBODY_SECS
            wait = default if fleet.wait_secs is None else fleet.wait_secs
            if time.monotonic() > started + wait:
                named = f' with id "{fleet.server}"' if fleet.server else ""
                raise RemoteFault(
                    f"environment servers at {self.place}: all sessions are in use; none became "
                    f"free within {wait:g} s"
                    if found
                    else f"no environment server{named} found at {self.place} within {wait:g} s "
                    f'(fleet "{fleet.fleet}"){misread}'
                )
            time.sleep(_LOOK_SECS)

    def watch(self, server: str, wake: Callable[[], None]) -> None:
        """Follows the server's liveliness token. wake: called when the token disappears."""

        def on_token(sample: Any) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                if self.is_absent and self._was_seen:
                    self.restored_at = time.monotonic()
                self.is_absent, self._was_seen = False, True
            else:
                self._absent_since, self._connected_since = time.monotonic(), None
                self.is_absent = True
                wake()

        self.declare(
            self.zenoh.liveliness().declare_subscriber(
                self._keys.server(server),
                zenoh.handlers.Callback(on_token, indirect=False),
                history=True,
            )
        )

    def loss(self) -> str:
        """How the watched server was lost, for messages; empty while it may still reply.

        A paused server may still reply: its endpoint accepts connections. A server behind a router
        may reply when the router or the connection returns before the server ends the session.
        """
        if not self.is_absent:
            return ""
        now, info = time.monotonic(), self.zenoh.info
        is_connected = bool([*info.routers_zid(), *info.peers_zid()])
        if not is_connected:
            self._connected_since = None
        elif self._connected_since is None:
            self._connected_since = now
        if self._is_routed and now < self._absent_since + _OUTAGE_SECS:
            return ""
        if self._connected_since is not None:
            return "is gone" if now > self._connected_since + _RETURN_SECS else ""
        if self._accepts():
            return ""
        return "cannot be reached: the router is gone" if self._is_routed else "is gone"

    def _accepts(self) -> bool:
        for one in self._fleet.connect:
            with contextlib.suppress(endpoint.Unreachable):
                endpoint.reach(one, _REACH_SECS)
                return True
        return False

    def _reach(self, wait: float) -> None:
        """Waits until an endpoint accepts connections: zenoh does not report why it cannot."""
        deadline = time.monotonic() + wait
        while True:
            problems = []
            for one in self._fleet.connect:
                try:
                    return endpoint.reach(one, min(_REACH_SECS, max(wait, _LOOK_SECS)))
                except endpoint.Unreachable as error:
                    problems.append(error)
            if time.monotonic() > deadline or all(error.is_final for error in problems):
                raise RemoteFault(
                    f"cannot connect to {'; '.join(map(str, problems))}; is `python -m rever_env "
                    f"serve --listen {self._fleet.connect[0]}` running?"
                )
            time.sleep(_LOOK_SECS)

    def _described(self) -> tuple[list[protocol.Description], str]:
        """All servers that reply, and why the description of another one cannot be read."""
        fleet, misread = self._fleet, ""
        key = self._keys.describe(fleet.server) if fleet.server else self._keys.describe_all()
        found = []
        timeout = _WAIT_SECS if fleet.wait_secs is None else max(fleet.wait_secs, _LOOK_SECS)
        for reply in self.zenoh.get(key, timeout=timeout):
            if reply.ok is not None:
                try:
                    found.append(protocol.DESCRIPTION.decode(reply.ok.payload.to_bytes()))
                except protocol.CodecError as error:  # another protocol version, for instance
                    misread = f"; a server's description cannot be read: {error}"
        return found, misread


def require_own_process() -> None:
    """ForkedProcess in a process that was forked after zenoh had been opened."""
    if _first_process and _first_process[0] != os.getpid():
        raise ForkedProcess(
            f"remote environments do not work in a forked process: process {_first_process[0]} "
            "opened the network before the fork; start processes with context='spawn' or "
            "'forkserver'"
        )


def _checked(connect: Iterable[str]) -> tuple[str, ...]:
    endpoints = tuple(endpoint.checked(one) for one in connect)
    if not endpoints:
        raise ValueError("connect: expected at least one endpoint, got none")
    return endpoints


_first_process: list[int] = []  # the process that opened zenoh first
_open_networks: "weakref.WeakSet[Network]" = weakref.WeakSet()


def _keep_inherited() -> None:
    """Keeps zenoh's objects in a forked process: freeing them waits for the parent's threads."""
    for network in _open_networks:
        for inherited in (network.zenoh, *network._declared):
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(inherited))


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_keep_inherited)
