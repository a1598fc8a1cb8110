"""What a policy sees before a decision."""

from dataclasses import dataclass

from rever_env.protocol import value
from rever_env.protocol.value import Action, State


@dataclass(frozen=True)
class Image:
    """A picture: height x width x 3 bytes, rows from the top, red green blue."""

    height: int
    width: int
    pixels: bytes


@dataclass(frozen=True)
class Observation:
    """Everything that a policy may know, and on request the expert's opinion."""

    image: Image
    state: State
    instruction: str
    expert_action: Action | None

    def validate(self) -> None:
        image = self.image
        fields = "image height", "image width"
        value.image_sides(fields, image.height, image.width)
        expected = image.height * image.width * 3
        if len(image.pixels) != expected:
            raise ValueError(
                f"image: expected {expected} bytes for {image.height} x {image.width} pixels, "
                f"got {len(image.pixels)}"
            )
        value.finite("state", self.state)
        value.text("instruction", self.instruction)
        if self.expert_action is not None:
            value.finite("expert_action", self.expert_action)
