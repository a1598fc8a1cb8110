"""The health subcommand: checks that the servers behind an endpoint answer."""

import argparse
import sys
import time
from pathlib import Path

from rever_env.argument_types import endpoint, fleet

_ASK_SECS = 2.0  # timeout of one query; a new link may not lead to a server yet


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of health."""
    parser.add_argument(
        "--connect",
        required=True,
        type=endpoint,
        metavar="ENDPOINT",
        help="endpoint of a server or a router, such as tcp/127.0.0.1:7448",
    )
    parser.add_argument(
        "--fleet",
        type=fleet,
        default="local",
        metavar="NAME",
        help="namespace: check only servers of this fleet (default: local)",
    )
    parser.add_argument(
        "--timeout-secs",
        type=float,
        default=5.0,
        metavar="SECONDS",
        help="timeout for an answer in seconds (default: 5)",
    )
    parser.add_argument(
        "--id-file",
        type=Path,
        metavar="FILE",
        help="check only the server that was started with this --id-file",
    )
    parser.set_defaults(run=health)


def health(arguments: argparse.Namespace) -> int:
    """Prints one line per server whose simulation thread answers; returns 1 if none does."""
    import zenoh

    from rever_env import protocol
    from rever_env.serving import Endpoints, cause
    from rever_env.tasks import TaskId

    seconds = arguments.timeout_secs
    endpoints = Endpoints((arguments.connect,), (), multicast=False, wait_secs=seconds)
    keys = protocol.Keys(arguments.fleet)
    deadline = time.monotonic() + seconds
    found, misread = 0, ""
    try:
        one = arguments.id_file and arguments.id_file.read_text(encoding="utf-8")
        network = zenoh.open(zenoh.Config.from_json5(endpoints.configuration()))
    except (OSError, zenoh.ZError) as error:
        return _unanswered(arguments, f": {cause(error)}")
    key = keys.describe(one) if one else keys.describe_all()
    with network:
        while not found and time.monotonic() < deadline:
            for reply in network.get(key, timeout=_ASK_SECS):
                if reply.ok is None:
                    continue
                try:
                    server = protocol.DESCRIPTION.decode(reply.ok.payload.to_bytes())
                except protocol.CodecError as error:
                    misread = f"; a server's description cannot be read: {error}"
                    continue
                tasks = ", ".join(str(TaskId(task.task, task.variant)) for task in server.tasks)
                print(
                    f"{server.server}: {server.sessions} of {server.sessions_max} sessions in "
                    f"use; tasks: {tasks}"
                )
                found += 1
    return 0 if found else _unanswered(arguments, misread)


def _unanswered(arguments: argparse.Namespace, why: str) -> int:
    print(
        f"error: no server of fleet {arguments.fleet} answered at {arguments.connect} "
        f"within {arguments.timeout_secs:g} s{why}",
        file=sys.stderr,
    )
    return 1
