"""Heartbeat: a server's simulation makes progress. Its liveliness token cannot show that."""

from dataclasses import dataclass

from rever_env.protocol import limits, value
from rever_env.protocol.value import U32


@dataclass(frozen=True)
class Heartbeat:
    """Sent by the simulation thread about twice a second."""

    server: str
    sessions: U32
    steps: int
    resident_bytes: int

    def validate(self) -> None:
        value.name("server", self.server)
        value.range("sessions", self.sessions, 0, limits.SESSIONS_MAX)
