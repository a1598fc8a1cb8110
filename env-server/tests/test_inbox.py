"""What waits for the simulation thread: in turn, and no more than is allowed."""

import time
from types import SimpleNamespace

import zenoh

from rever_env import protocol
from rever_env.inbox import Inbox


def work(inbox: Inbox) -> int:
    """Does all that waits; returns how much that was."""
    count = 0
    while (one := inbox.take(time.monotonic())) is not None:
        one()
        count += 1
    return count


def sample(content: bytes) -> SimpleNamespace:
    """As zenoh hands it to a callback."""
    return SimpleNamespace(payload=zenoh.ZBytes(content))


def test_sessions_take_turns_however_much_one_of_them_asks() -> None:
    inbox, done = Inbox(), list[tuple[str, object]]()
    flooding = inbox.session(lambda request: done.append(("flooding", request)))
    honest = inbox.session(lambda request: done.append(("honest", request)))
    for _ in range(1000):
        flooding(sample(b"flood"))
    honest(sample(b"step"))
    assert inbox.put_query(lambda: done.append(("query", None)))
    work(inbox)
    assert [name for name, _ in done[:3]] == ["flooding", "honest", "query"]
    assert done.count(("honest", b"step")) == 1
    assert len(done) == 6, "four requests of one session wait at most"


def test_queries_are_limited() -> None:
    inbox, answered = Inbox(), list[int]()
    taken = sum(inbox.put_query(lambda: answered.append(0)) for _ in range(1000))
    assert taken == work(inbox) == len(answered) == 64
    assert inbox.put_query(lambda: None)


def test_of_what_is_too_large_only_its_size_is_kept() -> None:
    inbox, asked = Inbox(), list[object]()
    put = inbox.session(asked.append)
    put(sample(bytes(protocol.limits.REQUEST_BYTES_MAX + 1)))
    put(sample(bytes(protocol.limits.REQUEST_BYTES_MAX)))
    work(inbox)
    assert str(asked[0]) == "request has 1025 bytes, limit 1024"
    assert asked[1] == bytes(protocol.limits.REQUEST_BYTES_MAX)


def test_nothing_is_waited_for_longer_than_told() -> None:
    begun = time.monotonic()
    assert Inbox().take(begun + 0.2) is None
    assert time.monotonic() >= begun + 0.2
