"""The serve subcommand: its arguments, the network it opens, and how it ends."""

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

_FINISH_SECS_MAX = 10.0  # a wedged simulation is given up after that
_CLOSE_SECS_MAX = 3.0
_PARENT_POLL_SECS = 0.5
_CONGESTION_MICROSECONDS = 60_000_000  # a slow reader holds a message up; it does not cost the link
_ENVELOPE_BYTES = 65_536  # what zenoh adds to a body
_SOURCE = re.compile(r"\s+at \S+\.rs:\d+\.?")  # where zenoh was built tells users nothing


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of serve."""
    parser.add_argument(
        "--connect",
        action="append",
        default=[],
        type=endpoint,
        metavar="ENDPOINT",
        help="a router or an agent to connect to, such as tcp/127.0.0.1:7447; repeatable",
    )
    parser.add_argument(
        "--listen",
        action="append",
        default=[],
        type=endpoint,
        metavar="ENDPOINT",
        help="where to listen, such as tcp/127.0.0.1:7448; every peer that reaches it is trusted; "
        "repeatable",
    )
    parser.add_argument(
        "--multicast",
        action="store_true",
        help="discover peers by multicast; without --listen, listen on every interface",
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
        help="largest number of sessions open at the same time (default: 16)",
    )
    parser.add_argument(
        "--exit-with-parent",
        type=int,
        nargs="?",
        const=os.getppid(),
        metavar="PID",
        help="exit when the process with this id (default: the current parent) is no longer the "
        "parent of this one",
    )
    parser.add_argument(
        "--id-file",
        type=Path,
        metavar="FILE",
        help="write the server's id into this file when it is ready, for `health`",
    )
    simulators.add_arguments(parser)
    parser.set_defaults(run=serve)


@dataclass(frozen=True)
class Endpoints:
    """Where zenoh connects to and listens; nothing else is opened."""

    connect: tuple[str, ...]
    listen: tuple[str, ...]
    multicast: bool
    # How long a client waits for the router or agent that it is told to connect to.
    wait_secs: float = 30.0

    @property
    def are_local(self) -> bool:
        """Whether all ways lead through the file system, to this machine alone."""
        ways = (*self.connect, *self.listen)
        return not self.multicast and all(way.startswith("unixsock-stream/") for way in ways)

    def configuration(self, message_bytes_max: int = limits.MESSAGE_BYTES_MAX) -> str:
        """zenoh's configuration in JSON. Larger messages are dropped as they arrive."""
        link = {"rx": {"max_message_size": message_bytes_max + _ENVELOPE_BYTES}}
        wait = {"wait_before_close": _CONGESTION_MICROSECONDS}
        queue = {"congestion_control": {"block": wait}}
        # Left out, this is a free port on every interface: what others find by multicast.
        by_multicast = self.multicast and not self.listen
        listen = {} if by_multicast else {"listen": {"endpoints": self.listen}}
        # A router forwards between its clients, not between its peers, which it takes for linked.
        # And a program with one way out and no way in needs no more than a client does.
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
    """An error of zenoh without the places in its source."""
    return _SOURCE.sub("", str(error))


def serve(arguments: argparse.Namespace) -> int:
    """Serves until a signal comes or the parent is gone.

    Prints a line that begins with `ready {server id}` when it can serve.
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
        # It holds the rendering contexts: no orderly end is left.
        logging.error("the simulation did not end within %.0f s", _FINISH_SECS_MAX)
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
    """What is wrong with the arguments together, if anything is."""
    if not (arguments.connect or arguments.listen or arguments.multicast):
        return "expected --connect, --listen or --multicast, got none"
    if arguments.id_file and not arguments.id_file.absolute().parent.is_dir():
        return f"--id-file {arguments.id_file}: expected it in a folder that exists"
    return ""


def _offer(worlds: "Worlds") -> str:
    """The tasks, by name, and the number of their variants if there are several."""
    variants: dict[str, int] = {}
    for task, _ in worlds.tasks:
        variants[task] = variants.get(task, 0) + 1
    return ", ".join(
        f"{task} in {count} variants" if count > 1 else task for task, count in variants.items()
    )


def _wait(stop: threading.Event, parent: int | None) -> None:
    while not stop.wait(_PARENT_POLL_SECS):
        if parent is not None and os.getppid() != parent:
            logging.info("the parent process %d is gone", parent)
            stop.set()
