"""Leasing a session."""

from dataclasses import dataclass

from rever_env.protocol import value
from rever_env.protocol.value import U32


@dataclass(frozen=True)
class Open:
    """The payload of a query on open. expert: observations carry the expert's action."""

    protocol: U32
    task: str
    variant: str
    image_height: U32
    image_width: U32
    expert: bool
    holder: str

    def validate(self) -> None:
        value.protocol(self.protocol)
        value.name("task", self.task)
        value.name("variant", self.variant)
        fields = "image_height", "image_width"
        value.image_sides(fields, self.image_height, self.image_width)
        value.name("holder", self.holder)


@dataclass(frozen=True)
class Opened:
    """The session is the asker's for as long as its liveliness token stands."""

    session: str

    def validate(self) -> None:
        value.name("session", self.session)


@dataclass(frozen=True)
class OpenRefused:
    """There is no session for the asker; on the wire its name is Refused."""

    reason: str

    def validate(self) -> None:
        value.text("reason", self.reason)
