"""The serve subcommand: arguments, network, and shutdown."""

import argparse
import json
import logging
import os
import re
import signal
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rever_env import simulators
from rever_env.argument_types import endpoint, fleet, session_count
from rever_env.protocol import limits

if TYPE_CHECKING:
    from rever_env.worlds import Worlds

_FINISH_SECS_MAX = 10.0  # timeout for the simulation thread at shutdown
_CLOSE_SECS_MAX = 3.0
_PARENT_POLL_SECS = 0.5
_CONGESTION_MICROSECONDS = 60_000_000  # a slow reader delays a message; its link stays open
_ENVELOPE_BYTES = 65_536  # zenoh's overhead per message
_SOURCE = re.compile(r"\s+at \S+\.rs:\d+\.?")  # source lines of zenoh, of no use in a message


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of serve."""
    parser.add_argument(
        "--connect",
        action="append",
        default=[],
        type=endpoint,
        metavar="ENDPOINT",
        help="connect to a router or an agent, such as tcp/127.0.0.1:7447; repeatable",
    )
    parser.add_argument(
        "--listen",
        action="append",
        default=[],
        type=endpoint,
        metavar="ENDPOINT",
        help="listen here, such as tcp/127.0.0.1:7448; every peer that can connect is trusted; "
        "repeatable",
    )
    parser.add_argument(
        "--multicast",
        action="store_true",
        help="discover peers by multicast; without --listen, listen on all interfaces",
    )
    parser.add_argument(
        "--fleet",
        type=fleet,
        default="local",
        metavar="NAME",
        help="namespace: peers see each other only within the same fleet (default: local)",
    )
    parser.add_argument(
        "--sessions",
        type=session_count,
        default=16,
        metavar="COUNT",
        help="maximum number of concurrent sessions (default: 16)",
    )
    parser.add_argument(
        "--exit-with-parent",
        type=int,
        nargs="?",
        const=os.getppid(),
        metavar="PID",
        help="exit when the parent process with this id ends (default: the current parent)",
    )
    parser.add_argument(
        "--id-file",
        type=Path,
        metavar="FILE",
        help="write the server's id to this file when it is ready, for `health --id-file`",
    )
    simulators.add_arguments(parser)
    parser.set_defaults(run=serve)


@dataclass(frozen=True)
class Endpoints:
    """Where zenoh connects to and listens; nothing else is opened."""

    connect: tuple[str, ...]
    listen: tuple[str, ...]
    multicast: bool
    wait_secs: float = 30.0  # timeout of a client's connection

    @property
    def are_local(self) -> bool:
        """Whether all endpoints are Unix sockets, which only this machine can reach."""
        endpoints = (*self.connect, *self.listen)
        return not self.multicast and all(one.startswith("unixsock-stream/") for one in endpoints)

    def configuration(self, message_bytes_max: int = limits.MESSAGE_BYTES_MAX) -> str:
        """zenoh's configuration in JSON. zenoh drops larger messages on receipt."""
        link = {"rx": {"max_message_size": message_bytes_max + _ENVELOPE_BYTES}}
        wait = {"wait_before_close": _CONGESTION_MICROSECONDS}
        queue = {"congestion_control": {"block": wait}}
        # Without this key zenoh listens on a free port of every interface, for multicast discovery.
        by_multicast = self.multicast and not self.listen
        listen = {} if by_multicast else {"listen": {"endpoints": self.listen}}
        # A router forwards between its clients, but not between its peers, because it assumes that
        # peers are linked directly. One outgoing connection and no listener make a client.
        is_client = len(self.connect) == 1 and not self.listen and not self.multicast
        return json.dumps(
            {
                "mode": "client" if is_client else "peer",
                "connect": {
                    "endpoints": self.connect,
                    "timeout_ms": {"client": round(1000 * self.wait_secs)},
                },
                **listen,
                "scouting": {
                    "multicast": {"enabled": self.multicast},
                    "gossip": {"enabled": self.multicast},
                },
                "transport": {
                    "link": {**link, "tx": {"queue": queue}},
                    "shared_memory": {"enabled": False},
                },
            }
        )

    def __str__(self) -> str:
        ways = {"listening on": self.listen, "connected to": self.connect}
        words = [f"{way} {', '.join(places)}" for way, places in ways.items() if places]
        return ", ".join([*words, *(["discovered by multicast"] if self.multicast else [])])


def cause(error: Exception) -> str:
    """The message of a zenoh error without source locations."""
    return _SOURCE.sub("", str(error))


def serve(arguments: argparse.Namespace) -> int:
    """Serves until SIGTERM, SIGINT or the end of the parent process; returns the exit status.

    Prints one line that begins with `ready {server id}` when it accepts sessions.
    """
    import zenoh

    from rever_env.server import Server, ServerOptions

    endpoints = Endpoints(tuple(arguments.connect), tuple(arguments.listen), arguments.multicast)
    problem = _wrong_usage(arguments)
    if problem:
        print(f"error: {problem}", file=sys.stderr)
        return 2
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    options = ServerOptions(arguments.fleet, arguments.sessions, whole_images=endpoints.are_local)
    try:
        worlds = simulators.make_worlds(arguments, options.sessions_max)
    except simulators.UnusedOption as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    configuration = endpoints.configuration(limits.SERVER_MESSAGE_BYTES_MAX)
    try:
        network = zenoh.open(zenoh.Config.from_json5(configuration))
    except zenoh.ZError as error:
        print(f"error: cannot open the network: {cause(error)}", file=sys.stderr)
        return 1
    try:
        server = Server(network, worlds, options)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2

    def ready(name: str) -> None:
        if arguments.id_file:
            arguments.id_file.write_text(name, encoding="utf-8")
        print(f"ready {name} {endpoints} (fleet {options.fleet}): {_offer(worlds)}", flush=True)

    failures: list[BaseException] = []

    def simulate() -> None:
        try:
            server.run(stop, ready)
        except BaseException as error:
            failures.append(error)
        finally:
            stop.set()

    thread = threading.Thread(target=simulate, name="simulation", daemon=True)
    thread.start()
    _wait(stop, arguments.exit_with_parent)
    thread.join(_FINISH_SECS_MAX)
    if thread.is_alive():
        # It holds the rendering contexts, so that an orderly shutdown is impossible.
        logging.error("the simulation thread did not end within %.0f s", _FINISH_SECS_MAX)
        os._exit(1)
    closing = threading.Thread(target=network.close, name="closing", daemon=True)
    closing.start()
    closing.join(_CLOSE_SECS_MAX)
    for failure in failures:
        raise failure
    if closing.is_alive():
        os._exit(0)  # zenoh still waits for a peer that reads nothing
    return 0


def _wrong_usage(arguments: argparse.Namespace) -> str:
    """Why the combination of arguments is invalid; empty if it is valid."""
    if not (arguments.connect or arguments.listen or arguments.multicast):
        return "expected --connect, --listen or --multicast, got none"
    if arguments.id_file and not arguments.id_file.absolute().parent.is_dir():
        return (
            f"--id-file {arguments.id_file}: expected an existing folder, got "
            f"{arguments.id_file.absolute().parent}"
        )
    return ""


def _offer(worlds: "Worlds") -> str:
    """The names of the tasks, with the number of their variants if there are several."""
    variants: dict[str, int] = {}
    for task, _ in worlds.tasks:
        variants[task] = variants.get(task, 0) + 1
    return ", ".join(
        f"{task} in {count} variants" if count > 1 else task for task, count in variants.items()
    )


def _wait(stop: threading.Event, parent: int | None) -> None:
    while not stop.wait(_PARENT_POLL_SECS):
        if parent is not None and os.getppid() != parent:
            logging.info("the parent process %d has ended", parent)
            stop.set()
