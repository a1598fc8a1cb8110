"""What waits for the simulation thread: bounded for each session, and taken from each in turn.

zenoh's threads only put, and never wait. A session's own flood fills its own queue and nobody
else's.
"""

import collections
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rever_env import protocol

_REQUESTS_MAX = 4  # of one session: its holder has one at a time and sends again what is dropped
_QUERIES_MAX = 64  # for all sessions together

Work = Callable[[], None]


@dataclass
class _Source:
    """Where work comes from; it takes its turn while something waits in it."""

    limit: int
    waiting: collections.deque[Work] = field(default_factory=collections.deque)


class Inbox:
    """Shared with zenoh's threads."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._turns: collections.deque[_Source] = collections.deque()
        self._queries = _Source(_QUERIES_MAX)

    def session(self, answer: Callable[[bytes | protocol.TooLarge], None]) -> Callable[[Any], None]:
        """A callback for the samples of a session's requests.

        It copies what is not too large; answer: called by the simulation thread.
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
        """Whether there was room."""
        return self._put(self._queries, work)

    def take(self, deadline: float) -> Work | None:
        """What is next, waited for until the deadline by the monotonic clock."""
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
