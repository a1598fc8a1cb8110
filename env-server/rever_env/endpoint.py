"""Endpoints of servers and routers: their syntax, and whether they accept connections."""

import re
import socket

_PROTOCOLS = ("tcp", "tls", "quic", "udp", "ws")
_PATHS = ("unixsock-stream", "unixpipe", "serial", "vsock")
_OVER_TCP = ("tcp", "tls", "ws")
_ENDPOINT = re.compile(
    r"(?:(?P<protocol>[a-z-]+)/)?(?P<host>[^\s/:\[\]?#]+|\[[^\s\]]+\]):(?P<port>\d{1,5})"
    r"(?P<settings>[?#]\S*)?"
)


def checked(endpoint: str) -> str:
    """The endpoint in zenoh's form; HOST:PORT means tcp/HOST:PORT. ValueError for other texts."""
    protocol, _, rest = str(endpoint).partition("/")
    if protocol in _PATHS and rest:
        return endpoint
    found = _ENDPOINT.fullmatch(str(endpoint))
    if (
        found is None
        or (found["protocol"] or "tcp") not in _PROTOCOLS
        or not 1 <= int(found["port"]) <= 65535
    ):
        raise ValueError(f"endpoint {endpoint!r}: expected tcp/HOST:PORT or HOST:PORT")
    return endpoint if found["protocol"] else f"tcp/{endpoint}"


class Unreachable(OSError):
    """An endpoint cannot be reached. is_final: a retry is useless, as for an unknown host."""

    def __init__(self, words: str, *, is_final: bool = False) -> None:
        super().__init__(words)
        self.is_final = is_final


def reach(endpoint: str, timeout: float) -> None:
    """Returns if the endpoint accepts connections or only zenoh can try it; else Unreachable."""
    protocol, _, address = endpoint.partition("/")
    if protocol == "unixsock-stream":
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(timeout)
            try:
                connection.connect(address)
            except OSError as error:
                raise Unreachable(f"{endpoint}: {error.strerror or error}") from None
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None or protocol not in _OVER_TCP:
        return
    try:
        socket.create_connection((found["host"].strip("[]"), int(found["port"])), timeout).close()
    except socket.gaierror as error:
        raise Unreachable(
            f"{endpoint}: host {found['host']}: {error.strerror}", is_final=True
        ) from None
    except ConnectionRefusedError:
        raise Unreachable(f"{endpoint}: connection refused") from None
    except TimeoutError:
        raise Unreachable(f"{endpoint}: no connection within {timeout:g} s") from None
    except OSError as error:
        raise Unreachable(f"{endpoint}: {error.strerror or error}") from None
