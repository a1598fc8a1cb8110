"""The health subcommand: asks the servers that an endpoint leads to whether they still work."""

import argparse
import sys
import time

_ASK_SECS = 2.0  # one query; a link that has just been opened may not lead anywhere yet


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments of health."""
    parser.add_argument("--connect", required=True, metavar="ENDPOINT", help="tcp/127.0.0.1:7448")
    parser.add_argument("--fleet", default="local", help="who meets whom (default: local)")
    parser.add_argument("--timeout-secs", type=float, default=5.0, help="(default: 5)")
    parser.set_defaults(run=health)


def health(arguments: argparse.Namespace) -> int:
    """Prints one line per server that answers from its simulation thread; fails if none does."""
    import zenoh

    from rever_env import protocol
    from rever_env.serving import Endpoints

    endpoints = Endpoints(connect=(arguments.connect,), listen=(), multicast=False)
    key = protocol.Keys(arguments.fleet).describe_all()
    deadline = time.monotonic() + arguments.timeout_secs
    found = 0
    with zenoh.open(zenoh.Config.from_json5(endpoints.configuration())) as network:
        while not found and time.monotonic() < deadline:
            for reply in network.get(key, timeout=_ASK_SECS):
                if reply.ok is None:
                    continue
                server = protocol.DESCRIPTION.decode(reply.ok.payload.to_bytes())
                print(
                    f"{server.server}: {server.sessions} of {server.sessions_max} sessions in use"
                )
                found += 1
    if not found:
        print(
            f"error: no server of fleet {arguments.fleet} answered at {arguments.connect} "
            f"within {arguments.timeout_secs:g} s",
            file=sys.stderr,
        )
    return 0 if found else 1
