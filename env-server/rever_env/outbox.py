"""What leaves the server, sent by other threads than the simulation's.

zenoh makes a sender wait for a peer that stops reading, up to a minute, and nobody else may wait
with it.
"""

import contextlib
import logging
import queue
import threading
from typing import Any

import zenoh

_log = logging.getLogger(__name__)

_ANSWERING_MAX = 64  # threads that answer queries at one time; almost always there is none
# Queries that wait for their end unanswered, and what they hold: more than ordinary use brings in
# the minute until zenoh closes the link of a peer that stopped reading.
_DISCARDED_MAX = 16_384
_DISCARDED_BYTES_MAX = 32 << 20


class Outbox:
    """A session's replies. close() ends its thread after the last one."""

    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher
        self._changed = threading.Condition()
        self._reply: bytes | None = None
        self._has_ended = False
        threading.Thread(target=self._send_all, name="replies", daemon=True).start()

    def send(self, reply: bytes) -> None:
        """Sends a reply in the place of one that still waits: its holder asks again for it."""
        with self._changed:
            self._reply = reply
            self._changed.notify()

    def close(self) -> None:
        """Sends nothing more than what waits."""
        with self._changed:
            self._has_ended = True
            self._changed.notify()

    def _send_all(self) -> None:
        while (reply := self._next()) is not None:
            try:
                self._publisher.put(reply)
            except zenoh.ZError as error:
                _log.warning("a reply was not sent: %s", error)
        with contextlib.suppress(zenoh.ZError):  # the network may be closed already
            self._publisher.undeclare()

    def _next(self) -> bytes | None:
        with self._changed:
            while self._reply is None and not self._has_ended:
                self._changed.wait()
            reply, self._reply = self._reply, None
            return reply


class Answers:
    """Answers to queries. zenoh tells the asker of a query's end, for which it may wait, too."""

    def __init__(self) -> None:
        self._answering = threading.Semaphore(_ANSWERING_MAX)
        self._discarded: queue.Queue[Any] = queue.Queue(_DISCARDED_MAX)
        self._discarded_bytes = 0
        self._counting = threading.Lock()
        threading.Thread(target=self._discard_all, name="discarded", daemon=True).start()

    def send(self, query: Any, key: str, answer: bytes) -> None:
        """Answers in a thread of its own; not where too many answers wait for their readers."""
        if not self._answering.acquire(blocking=False):
            self.discard(query)
            return

        def reply() -> None:
            try:
                query.reply(key, answer)
            except zenoh.ZError as error:
                _log.warning("a query was not answered: %s", error)
            finally:
                query.drop()
                self._answering.release()

        threading.Thread(target=reply, name="answer", daemon=True).start()

    def discard(self, query: Any) -> None:
        """Ends a query unanswered without waiting, but for a peer that reads none of many ends."""
        if self._discarded_bytes > _DISCARDED_BYTES_MAX:
            query.drop()
            return
        self._count(size(query))
        self._discarded.put(query)

    def close(self) -> None:
        """Ends the thread that ends queries; those that wait are ended before."""
        self._discarded.put(None)

    def _discard_all(self) -> None:
        while (query := self._discarded.get()) is not None:
            held = size(query)
            query.drop()
            self._count(-held)

    def _count(self, change: int) -> None:
        with self._counting:
            self._discarded_bytes += change


def size(query: Any) -> int:
    """Bytes of a query's payload."""
    return 0 if query.payload is None else len(query.payload)
