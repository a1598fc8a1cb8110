"""What a server answers, echoing the request's number."""

import enum
import math
import struct
from dataclasses import dataclass

import msgpack

from rever_env.protocol import limits, tiles, value
from rever_env.protocol.observation import Observation
from rever_env.protocol.statistics import Statistics
from rever_env.protocol.value import U32, Numbered

_ACTION_LENGTHS = range(1, limits.ACTION_DIMENSIONS_MAX + 1)


@dataclass(frozen=True)
class Transition:
    """The result of one control step."""

    observation: Observation
    statistics: Statistics
    reward: float
    terminated: bool
    truncated: bool


class FaultKind(str, enum.Enum):
    """What broke in the world."""

    PHYSICS_DIVERGED = "PhysicsDiverged"
    RENDERER_UNAVAILABLE = "RendererUnavailable"
    INTERNAL = "Internal"


@dataclass(frozen=True)
class Observed(Numbered):
    """To Reset."""

    sequence: int
    observation: Observation

    def validate(self) -> None:
        super().validate()
        self.observation.validate()


@dataclass(frozen=True)
class Stepped(Numbered):
    """To Step. simulator_us: microseconds of physics, picture and judge, without the wire.

    changed_tiles: None, or the image's pixels are those of these tiles only (tiles.complete).
    """

    sequence: int
    transition: Transition
    changed_tiles: tuple[U32, ...] | None
    simulator_us: U32

    def validate(self) -> None:
        super().validate()
        observation = self.transition.observation
        if self.changed_tiles is None:
            observation.image.validate()
        else:
            tiles.validate(observation.image, self.changed_tiles)
        observation.validate_rest()
        value.finite("reward", (self.transition.reward,))


@dataclass(frozen=True)
class Saved(Numbered):
    """To Save."""

    sequence: int


@dataclass(frozen=True)
class Restored(Numbered):
    """To Restore."""

    sequence: int
    observation: Observation

    def validate(self) -> None:
        super().validate()
        self.observation.validate()


@dataclass(frozen=True)
class Closed(Numbered):
    """To Close."""

    sequence: int


@dataclass(frozen=True)
class Refused:
    """The request was wrong; the world is unchanged. 0: its number is unknown or is no more."""

    sequence: int
    reason: str

    def validate(self) -> None:
        value.sequence(self.sequence, 0)
        value.text("reason", self.reason)


@dataclass(frozen=True)
class Faulted(Numbered):
    """The world broke: the episode is void, and only Reset or Close can follow."""

    sequence: int
    kind: FaultKind
    reason: str

    def validate(self) -> None:
        super().validate()
        value.text("reason", self.reason)


_PIXELS = b"\xa6pixels"
_NO_PIXELS = _PIXELS + b"\xc4\x00"
_BYTES_8, _BYTES_16, _BYTES_32 = (struct.Struct(">B" + form) for form in "BHI")
_packer = msgpack.Packer(use_single_float=True)


def stepped_in_layout(
    sequence: int,
    observation: Observation,
    pixels: bytes | memoryview,
    judged: tuple[Statistics, float, bool, bool],
    changed_tiles: tuple[int, ...] | None,
    simulator_us: int,
) -> bytes | None:
    """What the codec writes of the same Stepped, or None where it has to say what is wrong.

    pixels: in place of those of the observation's image. judged: statistics, reward, terminated,
    truncated. The pixels and the tiles' numbers belong together; tiles.changes gives them so.
    Nearly all replies are one, and right after a control step nothing of Python's is in the
    processor's caches: this touches little of it.
    """
    statistics, reward, terminated, truncated = judged
    image, state, expert_action = observation.image, observation.state, observation.expert_action
    total = sum(state, reward) + sum(expert_action or ())  # not finite if one of them is not
    if (
        not (math.isfinite(total) and abs(reward) <= limits.FLOAT_MAX)
        or len(state) > limits.STATE_DIMENSIONS_MAX
        or len(observation.instruction) > limits.TEXT_BYTES_MAX // 4  # characters of up to 4 bytes
        or (expert_action is not None and len(expert_action) not in _ACTION_LENGTHS)
        or image.height > limits.IMAGE_SIDE_MAX
        or image.width > limits.IMAGE_SIDE_MAX
    ):
        return None
    # The image's bytes are put in afterwards: MessagePack's writer would grow around them.
    data: bytes = _packer.pack(
        {
            "Stepped": {
                "sequence": sequence,
                "transition": {
                    "observation": {
                        "image": {"height": image.height, "width": image.width, "pixels": b""},
                        "state": state,
                        "instruction": observation.instruction,
                        "expert_action": expert_action,
                    },
                    "statistics": vars(statistics),
                    "reward": reward,
                    "terminated": terminated,
                    "truncated": truncated,
                },
                "changed_tiles": changed_tiles,
                "simulator_us": simulator_us,
            }
        }
    )
    count = len(pixels)
    if count >= 1 << 16:
        header = _BYTES_32.pack(0xC6, count)
    elif count >= 1 << 8:
        header = _BYTES_16.pack(0xC5, count)
    else:
        header = _BYTES_8.pack(0xC4, count)
    at = data.index(_NO_PIXELS)  # the first: nothing before it could hold so much
    return b"".join((data[:at], _PIXELS, header, pixels, data[at + len(_NO_PIXELS) :]))


Reply = Observed | Stepped | Saved | Restored | Closed | Refused | Faulted
