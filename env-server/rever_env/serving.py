"""The serve subcommand: its arguments, the network it opens, and how it ends."""

import argparse
import json
import logging
import os
import signal
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

from rever_env import simulators
from rever_env.protocol import limits

_FINISH_SECS_MAX = 10.0  # a wedged simulation is given up after that
_PARENT_POLL_SECS = 0.5
_CONGESTION_MICROSECONDS = 60_000_000  # a slow reader holds a reply up; it does not cost the link

# A reply with its picture is three of zenoh's batches or more: all of them fit into the queue at
# once, where two, zenoh's own choice, stop the simulation until the first one is gone.
_QUEUED_BATCHES = 16
# One pool of four threads for all that zenoh does, so that a message is not handed from one to
# another on its way. Not a single one: a callback that waits for Python's lock must stop nothing.
_ZENOH_RUNTIME = (
    "(acc: (handover: app), rx: (handover: app), tx: (handover: app), net: (handover: app), "
    "app: (worker_threads: 4))"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of serve."""
    parser.add_argument(
        "--connect", action="append", default=[], metavar="ENDPOINT", help="tcp/127.0.0.1:7447"
    )
    parser.add_argument("--listen", action="append", default=[], metavar="ENDPOINT")
    parser.add_argument(
        "--multicast",
        action="store_true",
        help="find others by multicast; without --listen, on every interface",
    )
    parser.add_argument("--fleet", default="local", help="who meets whom (default: local)")
    parser.add_argument("--sessions", type=int, default=16, help="at once (default: 16)")
    parser.add_argument(
        "--exit-with-parent",
        type=int,
        nargs="?",
        const=os.getppid(),
        metavar="PID",
        help="end when this parent process (default: the one that started it) is gone",
    )
    parser.add_argument(
        "--id-file", type=Path, help="write the server's id there when it is ready, for health"
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

    def configuration(self) -> str:
        """zenoh's configuration in JSON."""
        link = {"rx": {"max_message_size": limits.MESSAGE_BYTES_MAX + 65_536}}
        wait = {"wait_before_close": _CONGESTION_MICROSECONDS}
        queue = {"congestion_control": {"block": wait}, "size": {"data": _QUEUED_BATCHES}}
        # Left out, this is a free port on every interface: what others find by multicast.
        by_multicast = self.multicast and not self.listen
        listen = {} if by_multicast else {"listen": {"endpoints": self.listen}}
        # A router forwards between its clients, not between its peers, which it takes for linked.
        # And whoever has one way out and no way in needs no more than a client does.
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


def serve(arguments: argparse.Namespace) -> int:
    """Serves until a signal comes or the parent is gone; prints `ready {server id}` when it can."""
    import zenoh

    from rever_env.server import Server, ServerOptions

    if not (arguments.connect or arguments.listen or arguments.multicast):
        print("error: expected --connect, --listen or --multicast, got none", file=sys.stderr)
        return 2
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s", stream=sys.stderr)
    os.environ.setdefault("ZENOH_RUNTIME", _ZENOH_RUNTIME)  # read when zenoh is first used
    endpoints = Endpoints(tuple(arguments.connect), tuple(arguments.listen), arguments.multicast)
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    options = ServerOptions(
        arguments.fleet,
        arguments.sessions,
        whole_images=endpoints.are_local,
    )
    failures: list[BaseException] = []
    try:
        worlds = simulators.make_worlds(arguments, options.sessions_max)
    except simulators.UnusedOption as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        network = zenoh.open(zenoh.Config.from_json5(endpoints.configuration()))
    except zenoh.ZError as error:
        print(f"error: cannot open the network: {error}", file=sys.stderr)
        return 1
    with network:
        try:
            server = Server(network, worlds, options)
        except ValueError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2

        def ready(name: str) -> None:
            if arguments.id_file:
                arguments.id_file.write_text(name, encoding="utf-8")
            print(f"ready {name}", flush=True)

        def simulate() -> None:
            try:
                server.run(stop, ready)
            except BaseException as error:
                logging.exception("the simulation thread failed")
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
    return 1 if failures else 0


def _wait(stop: threading.Event, parent: int | None) -> None:
    while not stop.wait(_PARENT_POLL_SECS):
        if parent is not None and os.getppid() != parent:
            logging.info("the parent process %d is gone", parent)
            stop.set()
