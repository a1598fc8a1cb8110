"""The protocol between agents and environment servers: messages, codecs, zenoh keys, limits.

An agent reads a server's Description, opens a session with Open, and then sends one Request at a
time and waits for its Reply. The Rust crate `protocol` is the specification; protocol/golden in the
repository has the bytes of one example of each message. Units, shapes and control rate of a task
are in its TaskDescription.

Codecs (DESCRIPTION, OPEN, OPENING, REQUEST, REPLY, ...) have encode and decode. Both raise
CodecError: TooLarge, Malformed, or Invalid for a value out of bounds.
"""

from rever_env.protocol import limits
from rever_env.protocol.codec import Codec, CodecError, Invalid, Malformed, TooLarge
from rever_env.protocol.description import Description, Dimension, TaskDescription
from rever_env.protocol.heartbeat import Heartbeat
from rever_env.protocol.keys import PROTOCOL_VERSION, Keys
from rever_env.protocol.observation import Image, Observation
from rever_env.protocol.open import Open, Opened, OpenRefused
from rever_env.protocol.outcome import EpisodeOutcome
from rever_env.protocol.reply import (
    Closed,
    Faulted,
    FaultKind,
    Observed,
    Refused,
    Reply,
    Restored,
    Saved,
    Stepped,
    Transition,
)
from rever_env.protocol.request import (
    Close,
    Request,
    Reset,
    Restore,
    Save,
    Step,
)
from rever_env.protocol.statistics import Statistics
from rever_env.protocol.value import printable, recognise_protocol
from rever_env.protocol.verifier_update import VerifierUpdate

__all__ = [
    "DESCRIPTION",
    "HEARTBEAT",
    "OPEN",
    "OPENING",
    "OUTCOME",
    "PROTOCOL_VERSION",
    "REPLY",
    "REQUEST",
    "VERIFIER_UPDATE",
    "Close",
    "Closed",
    "Codec",
    "CodecError",
    "Description",
    "Dimension",
    "EpisodeOutcome",
    "FaultKind",
    "Faulted",
    "Heartbeat",
    "Image",
    "Invalid",
    "Keys",
    "Malformed",
    "Observation",
    "Observed",
    "Open",
    "OpenRefused",
    "Opened",
    "Refused",
    "Reply",
    "Request",
    "Reset",
    "Restore",
    "Restored",
    "Save",
    "Saved",
    "Statistics",
    "Step",
    "Stepped",
    "TaskDescription",
    "TooLarge",
    "Transition",
    "VerifierUpdate",
    "printable",
]

DESCRIPTION: Codec[Description] = Codec(
    "description", limits.DESCRIPTION_BYTES_MAX, Description, recognise_protocol
)
OPEN: Codec[Open] = Codec("open", limits.OPEN_BYTES_MAX, Open, recognise_protocol)
OPENING: Codec[Opened | OpenRefused] = Codec(
    "opening", limits.OPENING_BYTES_MAX, {"Opened": Opened, "Refused": OpenRefused}
)
REQUEST: Codec[Request] = Codec(
    "request",
    limits.REQUEST_BYTES_MAX,
    {kind.__name__: kind for kind in (Reset, Step, Save, Restore, Close)},
)
REPLY: Codec[Reply] = Codec(
    "reply",
    limits.REPLY_BYTES_MAX,
    {
        kind.__name__: kind
        for kind in (Observed, Stepped, Saved, Restored, Closed, Refused, Faulted)
    },
)
HEARTBEAT: Codec[Heartbeat] = Codec("heartbeat", limits.HEARTBEAT_BYTES_MAX, Heartbeat)
OUTCOME: Codec[EpisodeOutcome] = Codec("outcome", limits.OUTCOME_BYTES_MAX, EpisodeOutcome)
VERIFIER_UPDATE: Codec[VerifierUpdate] = Codec(
    "verifier update", limits.VERIFIER_UPDATE_BYTES_MAX, VerifierUpdate
)
