"""Open and its answers: leasing a session."""

from dataclasses import dataclass

from rever_env.protocol import value
from rever_env.protocol.value import U32


@dataclass(frozen=True)
class Open:
    """The payload of a query on the key open.

    image_height, image_width: pixels; 0 and 0 for no image. expert: observations have the action of
    the scripted expert. holder: a name for messages and logs.
    """

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
    """The session belongs to the asker while the asker's liveliness token exists."""

    session: str

    def validate(self) -> None:
        value.name("session", self.session)


@dataclass(frozen=True)
class OpenRefused:
    """The server refuses a session. On the wire the variant is called Refused."""

    reason: str

    def validate(self) -> None:
        value.text("reason", self.reason)
