"""The agent's side of the protocol in Python: one session, with resends and loss detection."""

import contextlib
import dataclasses
import os
import queue
import time
from collections.abc import Callable
from typing import Any

import zenoh

from rever_env import protocol
from rever_env.protocol import tiles
from rever_env.protocol.codec import M
from rever_env.remote_network import (
    Fleet,
    ForkedProcess,
    Network,
    RemoteFault,
    RemoteRefused,
    Wanted,
    require_own_process,
)

__all__ = ["Fleet", "RemoteFault", "RemoteRefused", "RemoteSession", "Wanted", "opened"]

_RESEND_SECS = 0.5  # then twice as long, and so on
_RESEND_SECS_MAX = 4.0
_LOOK_SECS = 0.1  # between two checks of a server whose token is gone
_OPEN_SECS = 60.0  # a server may have to create an environment first
_CLOSE_SECS = 2.0  # without a reply the session still ends, with its holder's token
# From a restored connection to a reply: a server ends the session of a holder it has lost.
_RESTORED_SECS = 15.0


class RemoteSession:
    """A session: requests are numbered and resent until a reply comes; close() ends the session.

    server: the server's id. description: what it offers. task: its description of the task.
    opened: the session's parameters. is_lost: no request will be answered; open a new session.
    """

    def __init__(self, fleet: Fleet, wanted: Wanted, *, is_return: bool = False) -> None:
        """is_return: the session replaces a lost one."""
        self._reply_secs = fleet.reply_secs
        self._keys = protocol.Keys(fleet.fleet)
        self._replies: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()  # None: wake up
        self._sequence = 0
        self._request = b""
        self._is_unanswered = False
        self._last_image = protocol.Image(0, 0, b"")  # what a step's tiles are laid on
        self._asked_at = self._answered_at = time.monotonic()
        self.is_lost = False
        self._network = Network(fleet, is_return=is_return)
        try:
            self._open(fleet, wanted)
        except BaseException:
            self._network.close()
            raise

    def ask(self, make: Callable[[int], protocol.Request]) -> protocol.Reply:
        """Sends the next request and waits for its reply."""
        self.send(make)
        return self.receive()

    def send(self, make: Callable[[int], protocol.Request]) -> None:
        """Sends the next request. make: creates it from its sequence number."""
        require_own_process()
        if self.is_lost:
            raise RemoteFault(f"{self._server}: the session is lost; reset opens a new one")
        request = make(self._sequence + 1)
        # A lost reply held a reward, and the image that later tiles change.
        if self._is_unanswered and not isinstance(request, protocol.Reset | protocol.Close):
            raise RemoteFault(
                f"{self._server}: expected Reset after a request whose reply was not taken, "
                f"got {type(request).__name__}"
            )
        self._refuse_early_replies()
        self._request = protocol.REQUEST.encode(request)
        self._sequence += 1
        self._is_unanswered = True
        self._asked_at = time.monotonic()
        self._publisher.put(self._request)

    def receive(self) -> protocol.Reply:
        """The reply to the last request; RemoteRefused or RemoteFault if the request failed."""
        reply = self._awaited()
        self._answered_at = time.monotonic()
        if isinstance(reply, protocol.Refused):
            self._is_unanswered = False
            if reply.sequence == 0:  # our requests are readable, so that it ends the session
                raise self._lost(f"refused: {protocol.printable(reply.reason)}")
            raise RemoteRefused(protocol.printable(reply.reason))
        if isinstance(reply, protocol.Faulted):
            self._is_unanswered = False
            reason = protocol.printable(reply.reason)
            raise RemoteFault(f"{self._server}: {reply.kind.value}: {reason}")
        whole = self._whole(reply)
        self._is_unanswered = False
        return whole

    def close(self) -> None:
        """Ends the session; does nothing in a forked process, because its parent uses it."""
        if not self._network.is_own:
            return
        if not self.is_lost:
            self._reply_secs = min(self._reply_secs, _CLOSE_SECS)
            with contextlib.suppress(RemoteFault, RemoteRefused, zenoh.ZError):
                self.ask(protocol.Close)
        self.is_lost = True
        self._network.close()

    @property
    def _server(self) -> str:
        return f"server {self.server} at {self._network.place}"

    def _lost(self, reason: str) -> RemoteFault:
        self.is_lost = True
        return RemoteFault(f"{self._server} {reason}")

    def _awaited(self) -> protocol.Reply:
        """Resends the request until its reply comes, the server is lost or the time is over."""
        wait, deadline = _RESEND_SECS, self._asked_at + self._reply_secs
        while True:
            reply = self._reply_within(min(wait, max(deadline - time.monotonic(), 0.0)))
            if reply is not None:
                return reply
            loss = self._network.loss()
            if loss:
                raise self._lost(loss)
            now = time.monotonic()
            if now >= deadline:
                raise self._lost(f"did not answer for {self._reply_secs:g} s")
            restored_at = self._network.restored_at
            if (
                restored_at > self._answered_at
                and now > max(restored_at, self._asked_at) + _RESTORED_SECS
            ):
                raise self._lost("is back, but the session was lost with the connection")
            if self._network.is_absent:
                wait = _LOOK_SECS
            else:
                self._publisher.put(self._request)
                wait = min(2.0 * max(wait, _RESEND_SECS), _RESEND_SECS_MAX)

    def _whole(self, reply: protocol.Reply) -> protocol.Reply:
        """The reply with its whole image; a Stepped may carry only the tiles that changed."""
        if isinstance(reply, protocol.Stepped):
            transition = reply.transition
            if reply.changed_tiles is not None:
                observation = transition.observation
                try:
                    image = tiles.complete(observation.image, reply.changed_tiles, self._last_image)
                except ValueError as error:
                    raise RemoteFault(f"{self._server}: {error}") from None
                observation = dataclasses.replace(observation, image=image)
                transition = dataclasses.replace(transition, observation=observation)
                reply = dataclasses.replace(reply, transition=transition, changed_tiles=None)
            self._last_image = transition.observation.image
        elif isinstance(reply, protocol.Observed | protocol.Restored):
            self._last_image = reply.observation.image
        return reply

    def _describe(self, description: protocol.Description, wanted: Wanted) -> None:
        self.server = description.server
        self.description = description
        task = wanted.among(description.tasks)
        assert task is not None, "the server was chosen for it"
        self.task = task
        has_images = description.image_side_max > 0
        self.opened = protocol.Open(
            protocol.PROTOCOL_VERSION,
            task.task,
            task.variant,
            wanted.image_height if has_images else 0,
            wanted.image_width if has_images else 0,
            wanted.expert,
            f"rever_env process {os.getpid()}",
        )

    def _open(self, fleet: Fleet, wanted: Wanted) -> None:
        description = self._network.find(wanted)
        self._describe(description, wanted)
        network = self._network.zenoh
        payload = protocol.OPEN.encode(self.opened)
        key = self._keys.open(description.server)
        answers = list(network.get(key, payload=payload, timeout=_OPEN_SECS))
        if not answers or answers[0].ok is None:
            raise RemoteFault(f"{self._server} did not answer Open within {_OPEN_SECS:g} s")
        opening = self._read(protocol.OPENING, answers[0].ok.payload.to_bytes())
        if isinstance(opening, protocol.OpenRefused):
            raise RemoteRefused(protocol.printable(opening.reason))
        name = opening.session
        self._network.watch(self.server, lambda: self._replies.put(None))
        self._network.declare(
            network.declare_subscriber(
                self._keys.reply(name),
                zenoh.handlers.Callback(self._on_reply, indirect=False),
            )
        )
        self._publisher = self._network.declare(
            network.declare_publisher(
                self._keys.request(name),
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
                express=True,
            )
        )
        self._network.declare(network.liveliness().declare_token(self._keys.session(name)))
        _last_found[:] = [(fleet, description)]

    def _on_reply(self, sample: Any) -> None:
        self._replies.put(sample.payload.to_bytes())

    def _reply_within(self, wait: float) -> protocol.Reply | None:
        """The next reply to the last request, or about the session itself (number 0).

        Late replies to earlier requests are dropped. None after the wait, or when the server's
        token disappears, so that the caller checks whether the server is lost.
        """
        deadline = time.monotonic() + wait
        while True:
            try:
                data = self._replies.get(timeout=max(deadline - time.monotonic(), 0.0))
            except queue.Empty:
                return None
            if data is None:
                return None
            reply = self._read(protocol.REPLY, data)
            if reply.sequence in (self._sequence, 0):
                return reply

    def _refuse_early_replies(self) -> None:
        """RemoteFault if the server has replied to a request that was not sent yet."""
        while True:
            try:
                data = self._replies.get_nowait()
            except queue.Empty:
                return
            reply = None if data is None else self._read(protocol.REPLY, data)
            if reply is not None and reply.sequence == 0 and isinstance(reply, protocol.Refused):
                raise self._lost(f"refused: {protocol.printable(reply.reason)}")
            if reply is not None and reply.sequence > self._sequence:
                raise self._lost(
                    f"sent reply {reply.sequence} before its request: expected at most "
                    f"{self._sequence}"
                )

    def _read(self, codec: protocol.Codec[M], data: bytes) -> M:
        """The decoded message; RemoteFault if it cannot be read."""
        try:
            return codec.decode(data)
        except protocol.CodecError as error:
            raise RemoteFault(f"{self._server}: {error}") from None


class ForkedSession(RemoteSession):
    """The session of a forked process: the parent's description, and a fault for every request.

    Gymnasium's AsyncVectorEnv reports what a worker's reset raises, but not what the creation of
    an environment raises there.
    """

    def __init__(self, fleet: Fleet, wanted: Wanted) -> None:
        """ForkedProcess if the parent found no such server and task."""
        for found, description in _last_found:
            if found == fleet and wanted.among(description.tasks) is not None:
                self.is_lost = False
                self._describe(description, wanted)
                return
        require_own_process()

    def close(self) -> None:
        """Does nothing: the parent owns the session."""


def opened(fleet: Fleet, wanted: Wanted) -> RemoteSession:
    """A new session; a ForkedSession in a process that was forked after zenoh was opened."""
    try:
        return RemoteSession(fleet, wanted)
    except ForkedProcess:
        return ForkedSession(fleet, wanted)


_last_found: list[tuple[Fleet, protocol.Description]] = []  # at most one
