"""Outgoing messages of a server, sent from other threads than the simulation thread.

zenoh blocks a sender for up to a minute if a peer stops reading. The simulation must not block.
"""

import contextlib
import logging
import queue
import threading
from typing import Any

import zenoh

_log = logging.getLogger(__name__)

_ANSWERING_MAX = 64  # concurrent threads that answer queries; usually there is none
# Discarded queries that wait for their end, and their bytes: more than ordinary use brings in the
# minute until zenoh closes the link of a peer that stopped reading.
_DISCARDED_MAX = 16_384
_DISCARDED_BYTES_MAX = 32 << 20


class Outbox:
    """The replies of a session. close() ends its thread after the last reply."""

    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher
        self._changed = threading.Condition()
        self._reply: bytes | None = None
        self._has_ended = False
        threading.Thread(target=self._send_all, name="replies", daemon=True).start()

    def send(self, reply: bytes) -> None:
        """Sends a reply in place of one that still waits: its holder resends the request."""
        with self._changed:
            self._reply = reply
            self._changed.notify()

    def close(self) -> None:
        """Ends the thread once the waiting reply is sent."""
        with self._changed:
            self._has_ended = True
            self._changed.notify()

    def _send_all(self) -> None:
        while (reply := self._next()) is not None:
            try:
                self._publisher.put(reply)
            except zenoh.ZError as error:
                _log.warning("cannot send a reply: %s", error)
        with contextlib.suppress(zenoh.ZError):  # the network may be closed already
            self._publisher.undeclare()

    def _next(self) -> bytes | None:
        with self._changed:
            while self._reply is None and not self._has_ended:
                self._changed.wait()
            reply, self._reply = self._reply, None
            return reply


class Answers:
    """Answers to queries. Ending a query sends a message, which may block as well."""

    def __init__(self) -> None:
        self._answering = threading.Semaphore(_ANSWERING_MAX)
        self._discarded: queue.Queue[Any] = queue.Queue(_DISCARDED_MAX)
        self._discarded_bytes = 0
        self._counting = threading.Lock()
        threading.Thread(target=self._discard_all, name="discarded", daemon=True).start()

    def send(self, query: Any, key: str, answer: bytes) -> None:
        """Answers in a new thread; discards the query if too many answers are blocked."""
        if not self._answering.acquire(blocking=False):
            self.discard(query)
            return

        def reply() -> None:
            try:
                query.reply(key, answer)
            except zenoh.ZError as error:
                _log.warning("cannot answer a query: %s", error)
            finally:
                query.drop()
                self._answering.release()

        threading.Thread(target=reply, name="answer", daemon=True).start()

    def discard(self, query: Any) -> None:
        """Ends a query unanswered. It blocks only if the queue of discarded queries is full."""
        if self._discarded_bytes > _DISCARDED_BYTES_MAX:
            query.drop()
            return
        self._count(size(query))
        self._discarded.put(query)

    def close(self) -> None:
        """Ends the thread after all waiting queries."""
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
    """The size of a query's payload in bytes."""
    return 0 if query.payload is None else len(query.payload)
