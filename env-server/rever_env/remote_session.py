"""The agent's end of the protocol in Python: one session, and what can go wrong."""

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
_LOOK_SECS = 0.1  # between looks for a server whose token is gone
_OPEN_SECS = 60.0  # a server may have to make an environment first
_CLOSE_SECS = 2.0  # the session ends with its holder's token, too
# From a restored connection to a reply: a server ends a session whose holder it has lost.
_RESTORED_SECS = 15.0


class RemoteSession:
    """Requests are numbered and sent again until a reply comes; close() ends the session.

    server: its id. task: what it says of the task. opened: what was asked for.
    is_lost: no request will be answered any more; a new session is needed.
    """

    def __init__(self, fleet: Fleet, wanted: Wanted, *, is_return: bool = False) -> None:
        """is_return: the session takes the place of one that is lost."""
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
        """Sends the next request; make: its number to the request."""
        require_own_process()
        if self.is_lost:
            raise RemoteFault(f"{self._server}: the session is lost, and reset opens a new one")
        request = make(self._sequence + 1)
        # What the lost reply brought is missing: a reward, and the image that tiles are laid on.
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
        """The reply to the last request; RemoteRefused or RemoteFault if it is none."""
        reply = self._awaited()
        self._answered_at = time.monotonic()
        if isinstance(reply, protocol.Refused):
            self._is_unanswered = False
            if reply.sequence == 0:  # every request of ours can be read: it is the session's end
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
        """Ends the session. In a forked process it is the parent's, and stays."""
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
        """Sends the request again until its reply comes, the server is gone or time is up."""
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
        """The reply with its whole image, which a step may bring in parts."""
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
        """Late replies to earlier requests are dropped; number 0 is about the session itself.

        None also when the server's token goes: the caller looks whether the server is gone.
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
        """A reply that is there before its request answers something that was not asked."""
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
        """What cannot be understood is no outcome."""
        try:
            return codec.decode(data)
        except protocol.CodecError as error:
            raise RemoteFault(f"{self._server}: {error}") from None


class ForkedSession(RemoteSession):
    """In a forked process: the description that the parent found, and a fault for every request.

    Gymnasium's AsyncVectorEnv tells what a reset raises in its workers, but not what making an
    environment raises there.
    """

    def __init__(self, fleet: Fleet, wanted: Wanted) -> None:
        """ForkedProcess where the parent found no such server and task."""
        for found, description in _last_found:
            if found == fleet and wanted.among(description.tasks) is not None:
                self.is_lost = False
                self._describe(description, wanted)
                return
        require_own_process()

    def close(self) -> None:
        """There is nothing to close."""


def opened(fleet: Fleet, wanted: Wanted) -> RemoteSession:
    """A new session."""
    try:
        return RemoteSession(fleet, wanted)
    except ForkedProcess:
        return ForkedSession(fleet, wanted)


_last_found: list[tuple[Fleet, protocol.Description]] = []  # one at most
