"""Serves a policy of the LeRobot package: SmolVLA, pi0, ACT and others that need one observation.

    python agent/training/serve_lerobot.py --model DIR [--image-key KEY] [--port 8001]

The folder is one of LeRobot's: config.json, model.safetensors, and the pre- and post-processor. The
client's camera becomes one image feature of the policy; other image features are black. Draws
follow the client's seed; the temperature is the policy's own.

Needs lerobot 0.4, and what policy_server.py needs.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot import __version__ as lerobot_version
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import OBS_STATE

import policy_server
from policy_server import Candidate, Description, Draw, Observation

TEMPERATURE = 1.0
# The key of the instruction in LeRobot's observations.
TASK = "task"
DEVICE = "cpu"


class LerobotPolicy:
    """A policy with its processors."""

    def __init__(self, folder: Path, image_key: str | None) -> None:
        names = files(folder)
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = DEVICE
        if config.n_obs_steps != 1:
            raise ValueError(
                f"n_obs_steps: expected 1, got {config.n_obs_steps}: "
                "the server keeps no earlier observations"
            )
        images = {key: feature.shape for key, feature in config.image_features.items()}
        self.image_key = choose(image_key, list(images))
        # (channels, height, width)
        self.image_shapes: dict[str, tuple[int, int, int]] = images
        state = config.robot_state_feature
        self.state_size: int | None = None if state is None else state.shape[0]
        self.policy = get_policy_class(config.type).from_pretrained(folder, config=config)
        self.before, self.after = make_pre_post_processors(
            config,
            pretrained_path=str(folder),
            preprocessor_overrides={"device_processor": {"device": DEVICE}},
        )
        _, height, width = images[self.image_key]
        self.description = Description(
            name=f"{config.type} of LeRobot {lerobot_version}",
            digest=policy_server.digest_of(folder, names, f"{lerobot_version} {self.image_key}"),
            temperature=TEMPERATURE,
            is_greedy=False,
            image_size=(height, width),
            action_scale=None,
        )

    def act(self, observation: Observation, draw: Draw) -> list[Candidate]:
        """(chunk, dimensions) each, in the units of the policy's data."""
        if draw.temperature != TEMPERATURE:
            raise ValueError(f"temperature: expected {TEMPERATURE}, got {draw.temperature}")
        batch = self.before(self.features(observation))
        # (1, ...) -> (candidates, ...)
        batch = {
            key: value.repeat_interleave(draw.candidates, 0)
            if isinstance(value, torch.Tensor)
            else value
            for key, value in batch.items()
        }
        # The policies draw their noise from PyTorch's global generator.
        torch.manual_seed(draw.seed)
        self.policy.reset()
        with torch.inference_mode():
            chunks = self.policy.predict_action_chunk(batch)
            # The post-processor takes one action per candidate: (candidates, dimensions).
            steps = [self.after(chunks[:, step]) for step in range(chunks.shape[1])]
        # (candidates, chunk, dimensions)
        actions = torch.stack(steps, dim=1).float().numpy()
        return list(actions.astype(np.float32))

    def features(self, observation: Observation) -> dict[str, Any]:
        """LeRobot's observation, without a batch dimension."""
        result: dict[str, Any] = {
            key: torch.zeros(shape) for key, shape in self.image_shapes.items()
        }
        _, height, width = self.image_shapes[self.image_key]
        if observation.image.shape != (height, width, 3):
            raise ValueError(f"image: expected {(height, width, 3)}, got {observation.image.shape}")
        # (height, width, 3) in 0..255 -> (3, height, width) in 0..1
        pixels = torch.from_numpy(np.array(observation.image)).permute(2, 0, 1)
        result[self.image_key] = pixels.float() / 255.0
        if self.state_size is not None:
            if observation.state.size != self.state_size:
                got = observation.state.size
                raise ValueError(f"state: expected {self.state_size} numbers, got {got}")
            result[OBS_STATE] = torch.from_numpy(np.array(observation.state))
        result[TASK] = observation.instruction
        return result


def choose(image_key: str | None, keys: list[str]) -> str:
    """The image feature for the camera; the first one if none is named."""
    if not keys:
        raise ValueError("image features: expected at least one, got none")
    if image_key is None:
        return keys[0]
    if image_key not in keys:
        raise ValueError(f"--image-key: expected one of {', '.join(keys)}, got {image_key}")
    return image_key


def files(folder: Path) -> list[str]:
    """The names of the files that determine what the policy computes."""
    config = folder / "config.json"
    if not config.is_file():
        raise ValueError(f"{folder}: expected config.json of a LeRobot policy, got none")
    if "type" not in json.loads(config.read_text(encoding="utf-8")):
        raise ValueError(f"{config}: expected the type of a LeRobot policy, got no type")
    return [path.name for path in folder.iterdir() if path.suffix in (".json", ".safetensors")]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--model", type=Path, required=True, help="folder of the policy")
    parser.add_argument("--image-key", help="image feature of the camera (default: the first)")
    policy_server.Options.declare(parser)
    arguments = parser.parse_args()
    options = policy_server.Options.of(arguments)
    torch.set_num_threads(options.threads)
    try:
        policy = LerobotPolicy(arguments.model, arguments.image_key)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    black = [key for key in policy.image_shapes if key != policy.image_key]
    if black:
        print(f"{policy.image_key} is the camera; black: {', '.join(black)}", file=sys.stderr)
    policy_server.serve(policy, options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
