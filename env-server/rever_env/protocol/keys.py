"""The zenoh keys under rever/3/{fleet}/, built from names that are checked."""

import re

PROTOCOL_VERSION = 3
_NAME = re.compile(r"[A-Za-z0-9._-]{1,64}")


class Keys:
    """All keys of one fleet: agents and servers meet only within the same one."""

    def __init__(self, fleet: str) -> None:
        self._prefix = f"rever/{PROTOCOL_VERSION}/{_checked('fleet', fleet)}"

    def server(self, server: str) -> str:
        """Liveliness token of a server: it exists."""
        return f"{self._prefix}/server/{_checked('server', server)}"

    def describe(self, server: str) -> str:
        """Queryable of a server: no payload, answered with a Description."""
        return f"{self.server(server)}/describe"

    def describe_all(self) -> str:
        """Matches describe of every server."""
        return f"{self._prefix}/server/*/describe"

    def open(self, server: str) -> str:
        """Queryable of a server: Open, answered with Opened or OpenRefused."""
        return f"{self.server(server)}/open"

    def heartbeat(self, server: str) -> str:
        """A server's Heartbeat."""
        return f"{self.server(server)}/heartbeat"

    def session(self, session: str) -> str:
        """Liveliness token of an agent: the holder of this session is alive."""
        return f"{self._prefix}/session/{_checked('session', session)}"

    def request(self, session: str) -> str:
        """A holder's Request."""
        return f"{self.session(session)}/request"

    def reply(self, session: str) -> str:
        """A server's Reply."""
        return f"{self.session(session)}/reply"

    def outcome(self, run: str) -> str:
        """EpisodeOutcome of a run."""
        return f"{self._prefix}/outcome/{_checked('run', run)}"

    def verifier(self, name: str) -> str:
        """VerifierUpdate of a verifier."""
        return f"{self._prefix}/verifier/{_checked('verifier', name)}"


def _checked(what: str, name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ValueError(
            f'{what} "{name}" cannot stand in a key: expected 1 to 64 of a-z A-Z 0-9 . _ -'
        )
    return name
