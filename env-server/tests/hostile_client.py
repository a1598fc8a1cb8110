"""A client that misbehaves: `hostile_client.py ENDPOINT DEED`, a child process of the tests.

It says "done" when it has done its worst, and then waits to be killed.
"""

import os
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import zenoh

from rever_env import protocol
from rever_env.serving import Endpoints

KEYS = protocol.Keys("local")
WAIT_SECS = 60.0
SPOON = "widowx_spoon_on_towel"
FLOOD_SECS = 4.0


def main(endpoint: str, deed: str) -> None:
    # A small buffer is full soon after its reader has stopped.
    configuration = Endpoints((f"{endpoint}#so_rcvbuf=4096",), (), multicast=False).configuration()
    with zenoh.open(zenoh.Config.from_json5(configuration)) as network:
        DEEDS[deed](network)
        print("done", flush=True)
        signal.pause()


def description(network: zenoh.Session) -> protocol.Description:
    while True:
        for reply in network.get(KEYS.describe_all(), timeout=WAIT_SECS):
            if reply.ok is not None:
                return protocol.DESCRIPTION.decode(reply.ok.payload.to_bytes())


class Held:
    """A session whose replies are not looked at, but for the first."""

    def __init__(self, network: zenoh.Session, server: str, side: int) -> None:
        opened = protocol.Open(
            protocol.PROTOCOL_VERSION, SPOON, "default", side, side, False, "hostile"
        )
        payload = protocol.OPEN.encode(opened)
        (answer,) = network.get(KEYS.open(server), payload=payload, timeout=WAIT_SECS)
        assert answer.ok is not None
        opening = protocol.OPENING.decode(answer.ok.payload.to_bytes())
        assert isinstance(opening, protocol.Opened), opening
        name = opening.session
        self.replies = network.declare_subscriber(KEYS.reply(name), zenoh.handlers.RingChannel(1))
        self.token = network.liveliness().declare_token(KEYS.session(name))
        self.requests = network.declare_publisher(
            KEYS.request(name), congestion_control=zenoh.CongestionControl.BLOCK, express=True
        )
        self.reset = protocol.REQUEST.encode(protocol.Reset(1, SPOON, "default", 3, 7))
        self.requests.put(self.reset)
        self.replies.recv()  # its world is made


def stop_reading_replies(network: zenoh.Session) -> None:
    """Asks for more large images than any buffer holds, and stops."""
    server = description(network).server
    held = [Held(network, server, protocol.limits.IMAGE_SIDE_MAX) for _ in range(4)]
    for _ in range(8):
        for session in held:
            session.requests.put(session.reset)
    held[-1].replies.recv()  # the requests have arrived
    print("done", flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)


def stop_reading_answers(network: zenoh.Session) -> None:
    """Asks for more descriptions than any buffer holds, and stops."""
    server = description(network).server
    kept: list[Any] = []
    for _ in range(6_000):
        network.get(KEYS.describe(server), kept.append, timeout=WAIT_SECS)
    print("done", flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)


def tiny_messages(network: zenoh.Session) -> None:
    """Thousands of requests, opens and questions of one byte, at once."""
    server = description(network).server
    held = Held(network, server, 8)
    answers: list[Any] = []
    for count in range(10_000):
        held.requests.put(b"\xc1")
        if count % 5 == 0:
            network.get(KEYS.open(server), answers.append, payload=b"\xc1", timeout=WAIT_SECS)
            network.get(KEYS.describe(server), answers.append, payload=b"\xc1", timeout=WAIT_SECS)


def flood_own_session(network: zenoh.Session) -> None:
    """Garbage and repeated requests as fast as they go, for some seconds."""
    held = Held(network, description(network).server, 8)
    print("begun", flush=True)
    end = time.monotonic() + FLOOD_SECS
    while time.monotonic() < end:
        for _ in range(100):
            held.requests.put(b"\xc1")
            held.requests.put(held.reset)


def large_messages(network: zenoh.Session) -> None:
    """Requests and opens far beyond their limits, of all sizes."""
    server = description(network).server
    held = Held(network, server, 8)
    for size in (1 << 11, 1 << 16, 1 << 20, 1 << 23, 60 << 20):
        for _ in range(4):
            held.requests.put(bytes(size))
            network.get(KEYS.open(server), lambda _: None, payload=bytes(size), timeout=WAIT_SECS)


DEEDS: dict[str, Callable[[zenoh.Session], None]] = {
    deed.__name__: deed
    for deed in (
        stop_reading_replies,
        stop_reading_answers,
        tiny_messages,
        flood_own_session,
        large_messages,
    )
}

if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
