"""The zenoh keys under rever/3/{fleet}/, built from validated names."""

import re

PROTOCOL_VERSION = 3
_NAME = re.compile(r"[A-Za-z0-9._-]{1,64}")


class Keys:
    """The keys of one fleet. Peers see each other only within the same fleet.

    ValueError for names that are not 1 to 64 of a-z A-Z 0-9 . _ -
    """

    def __init__(self, fleet: str) -> None:
        self._prefix = f"rever/{PROTOCOL_VERSION}/{_checked('fleet', fleet)}"

    def server(self, server: str) -> str:
        """Liveliness token of a server."""
        return f"{self._prefix}/server/{_checked('server', server)}"

    def describe(self, server: str) -> str:
        """Queryable of a server: no payload; the answer is a Description."""
        return f"{self.server(server)}/describe"

    def describe_all(self) -> str:
        """Matches the key describe of every server."""
        return f"{self._prefix}/server/*/describe"

    def open(self, server: str) -> str:
        """Queryable of a server: Open; the answer is Opened or OpenRefused."""
        return f"{self.server(server)}/open"

    def heartbeat(self, server: str) -> str:
        """Heartbeats of a server."""
        return f"{self.server(server)}/heartbeat"

    def session(self, session: str) -> str:
        """Liveliness token of the agent that holds this session."""
        return f"{self._prefix}/session/{_checked('session', session)}"

    def request(self, session: str) -> str:
        """Requests of the holder."""
        return f"{self.session(session)}/request"

    def reply(self, session: str) -> str:
        """Replies of the server."""
        return f"{self.session(session)}/reply"

    def outcome(self, run: str) -> str:
        """EpisodeOutcomes of a run."""
        return f"{self._prefix}/outcome/{_checked('run', run)}"

    def verifier(self, name: str) -> str:
        """VerifierUpdates of a verifier."""
        return f"{self._prefix}/verifier/{_checked('verifier', name)}"


def _checked(what: str, name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ValueError(
            f'invalid {what} name "{name}": expected 1 to 64 characters from a-z A-Z 0-9 . _ -'
        )
    return name
