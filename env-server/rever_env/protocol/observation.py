"""Observation: what a policy sees before a decision."""

from dataclasses import dataclass

from rever_env.protocol import limits, value


@dataclass(frozen=True)
class Image:
    """An RGB image: height x width x 3 bytes, rows from the top."""

    height: int
    width: int
    pixels: bytes

    def validate(self) -> None:
        self.validate_sides()
        expected = self.height * self.width * 3
        if len(self.pixels) != expected:
            raise ValueError(
                f"image: expected {expected} bytes for {self.height} x {self.width} pixels, "
                f"got {len(self.pixels)}"
            )

    def validate_sides(self) -> None:
        fields = "image height", "image width"
        value.image_sides(fields, self.height, self.width)


@dataclass(frozen=True)
class Observation:
    """The input of a policy.

    state: the numbers that TaskDescription.state describes, with their units. expert_action: the
    action of the scripted expert, as TaskDescription.action describes; None unless Open.expert.
    """

    image: Image
    state: tuple[float, ...]
    instruction: str
    expert_action: tuple[float, ...] | None

    def validate(self) -> None:
        self.image.validate()
        self.validate_rest()

    def validate_rest(self) -> None:
        """All but the image."""
        value.length("state", self.state, 0, limits.STATE_DIMENSIONS_MAX)
        value.finite("state", self.state)
        value.text("instruction", self.instruction)
        if self.expert_action is not None:
            value.length("expert_action", self.expert_action, 1, limits.ACTION_DIMENSIONS_MAX)
            value.finite("expert_action", self.expert_action)
