"""The agent's end of the protocol in Python: one leased session, and what can go wrong."""

import contextlib
import dataclasses
import os
import queue
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh

from rever_env import protocol
from rever_env.protocol import tiles
from rever_env.protocol.codec import M
from rever_env.serving import Endpoints

_LOOK_SECS = 0.2  # between looks at who is there
_RESEND_SECS = 0.5  # then twice as long, and so on
_RESEND_SECS_MAX = 4.0
_OPEN_SECS = 60.0  # a server may have to make a world first


class RemoteFault(RuntimeError):
    """The world or the way to it broke: the episode has no outcome.

    The next reset may work. Where the session itself is gone, with its server or for its long
    silence, it will not, and the environment has to be made again.
    """


class RemoteRefused(ValueError):
    """The server refused a request; its world is unchanged."""


@dataclass(frozen=True)
class Fleet:
    """Which servers. connect: endpoints of servers or of a router, as tcp/HOST:PORT.

    server: its id; without one, the server with most free sessions.
    """

    connect: tuple[str, ...]
    fleet: str = "local"
    server: str | None = None
    wait_secs: float = 30.0  # for a server to be there
    reply_secs: float = 120.0  # for a reply, whatever is sent again meanwhile


class RemoteSession:
    """Requests are numbered and sent again until a reply comes; close() ends the session."""

    def __init__(self, fleet: Fleet, ask: Callable[[protocol.Description], protocol.Open]) -> None:
        """ask: turns the server's description into what is opened."""
        self._fleet = fleet
        self._keys = protocol.Keys(fleet.fleet)
        endpoints = Endpoints(fleet.connect, (), multicast=False, wait_secs=fleet.wait_secs)
        try:
            self._network = zenoh.open(zenoh.Config.from_json5(endpoints.configuration()))
        except zenoh.ZError as error:
            raise RemoteFault(f"cannot reach {fleet.connect}: {error}") from None
        self._replies: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._sequence = 0
        self._request = b""
        self._is_unanswered = False
        self._last_image = protocol.Image(0, 0, b"")  # what a step's tiles are laid on
        self._asked_at = 0.0
        self._end = ""  # why the server ended the session
        self._declared: list[Any] = []
        try:
            self._open(ask)
        except BaseException:
            self._network.close()  # type: ignore[no-untyped-call]
            raise

    def ask(self, make: Callable[[int], protocol.Request]) -> protocol.Reply:
        """Sends the next request and waits for its reply."""
        self.send(make)
        return self.receive()

    def send(self, make: Callable[[int], protocol.Request]) -> None:
        """Sends the next request; make: its number to the request."""
        if self._end:
            raise RemoteRefused(self._end)  # nobody would answer
        request = make(self._sequence + 1)
        # What the lost reply brought is missing: a reward, and the picture that tiles are laid on.
        if self._is_unanswered and not isinstance(request, protocol.Reset | protocol.Close):
            raise RemoteFault(
                f"server {self.server}: expected Reset after a request whose reply was not taken, "
                f"got {type(request).__name__}"
            )
        self._request = protocol.REQUEST.encode(request)
        self._sequence += 1
        self._is_unanswered = True
        self._asked_at = time.monotonic()
        self._publisher.put(self._request)

    def receive(self) -> protocol.Reply:
        """The reply to the last request; RemoteRefused or RemoteFault if it is none."""
        wait = _RESEND_SECS
        while True:
            reply = self._reply_within(wait)
            if reply is not None:
                break
            waited = time.monotonic() - self._asked_at
            if waited > self._fleet.reply_secs or not self._is_alive():
                raise RemoteFault(f"server {self.server}: no reply within {waited:.0f} s")
            self._publisher.put(self._request)
            wait = min(2.0 * wait, _RESEND_SECS_MAX)
        if isinstance(reply, protocol.Refused):
            self._is_unanswered = False
            if reply.sequence == 0:  # every request of ours can be read: it is the session's end
                self._end = reply.reason
            raise RemoteRefused(reply.reason)
        if isinstance(reply, protocol.Faulted):
            self._is_unanswered = False
            raise RemoteFault(f"server {self.server}: {reply.kind.value}: {reply.reason}")
        whole = self._whole(reply)
        self._is_unanswered = False
        return whole

    def close(self) -> None:
        """Ends the session; a server that is gone has ended it already."""
        with contextlib.suppress(RemoteFault, RemoteRefused, zenoh.ZError):
            if self._is_alive():
                self.ask(protocol.Close)
        for declared in reversed(self._declared):
            declared.undeclare()
        self._network.close()  # type: ignore[no-untyped-call]

    def _whole(self, reply: protocol.Reply) -> protocol.Reply:
        """The reply with its whole image, which a step may bring in parts."""
        if isinstance(reply, protocol.Stepped):
            transition = reply.transition
            if reply.changed_tiles is not None:
                observation = transition.observation
                try:
                    image = tiles.complete(observation.image, reply.changed_tiles, self._last_image)
                except ValueError as error:
                    raise RemoteFault(f"server {self.server}: {error}") from None
                observation = dataclasses.replace(observation, image=image)
                transition = dataclasses.replace(transition, observation=observation)
                reply = dataclasses.replace(reply, transition=transition, changed_tiles=None)
            self._last_image = transition.observation.image
        elif isinstance(reply, protocol.Observed | protocol.Restored):
            self._last_image = reply.observation.image
        return reply

    def _open(self, ask: Callable[[protocol.Description], protocol.Open]) -> None:
        description = self._find()
        self.server = description.server
        self.description = description
        opened = self.opened = ask(description)
        wanted = [
            task
            for task in description.tasks
            if (task.task, task.variant) == (opened.task, opened.variant)
        ]
        if not wanted:
            offered = ", ".join(f"{task.task} ({task.variant})" for task in description.tasks)
            raise RemoteRefused(
                f"expected one of the tasks {offered}, got {opened.task} ({opened.variant})"
            )
        self.task = wanted[0]
        payload = protocol.OPEN.encode(opened)
        key = self._keys.open(description.server)
        answers = list(self._network.get(key, payload=payload, timeout=_OPEN_SECS))
        if not answers or answers[0].ok is None:
            raise RemoteFault(f"server {description.server} did not answer Open")
        opening = self._read(protocol.OPENING, answers[0].ok.payload.to_bytes())
        if isinstance(opening, protocol.OpenRefused):
            raise RemoteRefused(opening.reason)
        name = opening.session
        self._declared.append(
            self._network.declare_subscriber(
                self._keys.reply(name),
                zenoh.handlers.Callback(self._on_reply, indirect=False),
            )
        )
        self._publisher = self._network.declare_publisher(
            self._keys.request(name),
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
            express=True,
        )
        self._declared.append(self._publisher)
        self._declared.append(self._network.liveliness().declare_token(self._keys.session(name)))

    def _find(self) -> protocol.Description:
        """The named server, or the one with most free sessions."""
        fleet = self._fleet
        key = self._keys.describe(fleet.server) if fleet.server else self._keys.describe_all()
        strange = ""
        deadline = time.monotonic() + fleet.wait_secs
        while True:
            found = []
            for reply in self._network.get(key, timeout=fleet.wait_secs):
                if reply.ok is not None:
                    try:
                        found.append(protocol.DESCRIPTION.decode(reply.ok.payload.to_bytes()))
                    except protocol.CodecError as error:  # of another version, for instance
                        strange = f"; one cannot be understood: {error}"
            free = [server for server in found if server.sessions < server.sessions_max]
            if free:
                return max(free, key=lambda server: server.sessions_max - server.sessions)
            if time.monotonic() > deadline:
                what = "none has a free session" if found else "none was to be seen"
                raise RemoteFault(
                    f"servers of fleet {fleet.fleet} at {', '.join(fleet.connect)}: {what} "
                    f"within {fleet.wait_secs:g} s{strange}"
                )
            time.sleep(_LOOK_SECS)

    def _is_alive(self) -> bool:
        tokens = self._network.liveliness().get(self._keys.server(self.server), timeout=2.0)
        return any(reply.ok is not None for reply in tokens)

    def _on_reply(self, sample: Any) -> None:
        self._replies.put(sample.payload.to_bytes())

    def _reply_within(self, wait: float) -> protocol.Reply | None:
        """Late replies to earlier requests are dropped; number 0 is about the session itself."""
        deadline = time.monotonic() + wait
        while True:
            try:
                data = self._replies.get(timeout=max(deadline - time.monotonic(), 0.0))
            except queue.Empty:
                return None
            reply = self._read(protocol.REPLY, data)
            if reply.sequence in (self._sequence, 0):
                return reply

    def _read(self, codec: protocol.Codec[M], data: bytes) -> M:
        """What cannot be understood is no outcome."""
        try:
            return codec.decode(data)
        except protocol.CodecError as error:
            raise RemoteFault(f"server {self.server}: {error}") from None


def holder() -> str:
    """Who holds a session, for the server's log."""
    return f"rever_env process {os.getpid()}"
