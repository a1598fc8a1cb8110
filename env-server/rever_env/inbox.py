"""Queues of work for the simulation thread: bounded per session and served round-robin.

zenoh's threads only put work and never block. A flood from one session fills only its own queue.
"""

import collections
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rever_env import protocol

_REQUESTS_MAX = 4  # per session: its holder sends one request at a time and resends a dropped one
_QUERIES_MAX = 64  # for all queries together

Work = Callable[[], None]


@dataclass
class _Source:
    """A queue of one origin; it takes its turn while it is not empty."""

    limit: int
    waiting: collections.deque[Work] = field(default_factory=collections.deque)


class Inbox:
    """The queues. zenoh's threads put, the simulation thread takes."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._turns: collections.deque[_Source] = collections.deque()
        self._queries = _Source(_QUERIES_MAX)

    def session(self, answer: Callable[[bytes | protocol.TooLarge], None]) -> Callable[[Any], None]:
        """A callback for the samples of a session's requests.

        It copies requests up to the size limit. answer: called by the simulation thread.
        """
        source = _Source(_REQUESTS_MAX)

        def on_request(sample: Any) -> None:
            if len(source.waiting) >= _REQUESTS_MAX:
                return
            request: bytes | protocol.TooLarge
            try:
                protocol.REQUEST.check_size(len(sample.payload))
                request = sample.payload.to_bytes()
            except protocol.TooLarge as error:
                request = error
            self._put(source, lambda: answer(request))

        return on_request

    def put_query(self, work: Work) -> bool:
        """Whether the queue had room."""
        return self._put(self._queries, work)

    def take(self, deadline: float) -> Work | None:
        """The next work; waits until the deadline of the monotonic clock."""
        with self._changed:
            while not self._turns:
                left = deadline - time.monotonic()
                if left <= 0.0:
                    return None
                self._changed.wait(left)
            source = self._turns.popleft()
            work = source.waiting.popleft()
            if source.waiting:
                self._turns.append(source)
            return work

    def _put(self, source: _Source, work: Work) -> bool:
        with self._changed:
            if len(source.waiting) >= source.limit:
                return False
            source.waiting.append(work)
            if len(source.waiting) == 1:
                self._turns.append(source)
            self._changed.notify()
            return True
