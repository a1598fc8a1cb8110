"""Serves a checkpoint of this folder's networks: bridge-small's kind, or bridge-flow's.

    python agent/training/serve.py --model DIR [--wire openpi] [--port 8001]

Needs torch, safetensors, tokenizers, and what policy_server.py needs. Profiles for `rever evaluate
--policy-profile`: serve.toml for bridge-small, serve_flow.toml for bridge-flow.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import torch

import checkpoint
import flow
import policy_server
from actions import DIMENSIONS, Statistics, world_from_model
from generation import COMPLETION_TOKENS, decode, generate
from policy_server import Candidate, Description, Draw, Observation

FILES = ["config.json", "model.safetensors", "tokenizer.json"]
# Closed is -1, open is 1.
GRIPPER_SPAN = 2.0


class TokenPolicy:
    """A network that writes tokens, `model_type` openvla: one action per decision."""

    def __init__(self, folder: Path) -> None:
        self.checkpoint = checkpoint.read(folder)
        side = self.checkpoint.network.config.vision.image_size
        self.description = describe(folder, 0.0, side, self.checkpoint.statistics)

    def act(self, observation: Observation, draw: Draw) -> list[Candidate]:
        """(1, 7) each: metres, rotation vector, gripper +1 open and -1 closed."""
        check_image(observation, self.description)
        tokenizer = self.checkpoint.tokenizer
        image = torch.from_numpy(np.array(observation.image))[None]
        prompt = torch.tensor([tokenizer.prompt(observation.instruction)])
        completion = generate(
            self.checkpoint.network,
            image.expand(draw.candidates, -1, -1, -1),
            prompt.expand(draw.candidates, -1),
            COMPLETION_TOKENS,
            draw.temperature,
            torch.Generator().manual_seed(draw.seed),
        ).numpy()
        actions, well_formed = decode(self.checkpoint, completion)
        return [
            action[None].astype(np.float32)
            if is_right
            else f"expected {DIMENSIONS} action tokens and the end, got {row[-1 - DIMENSIONS :]}"
            for action, is_right, row in zip(actions, well_formed, completion, strict=True)
        ]


class FlowPolicy:
    """A network that integrates noise to a chunk of actions, `model_type` rever-flow."""

    def __init__(self, folder: Path) -> None:
        self.policy = flow.read(folder)
        side = self.policy.network.config.vision.image_size
        self.description = describe(folder, 1.0, side, self.policy.statistics)

    def act(self, observation: Observation, draw: Draw) -> list[Candidate]:
        """(chunk, 7) each: metres, rotation vector, gripper +1 open and -1 closed."""
        check_image(observation, self.description)
        if observation.state.shape != (flow.STATE_NUMBERS,):
            expected, got = flow.STATE_NUMBERS, observation.state.size
            raise ValueError(f"state: expected {expected} numbers, got {got}")
        longest = self.policy.network.config.prompt
        tokens = len(self.policy.tokenizer.prompt(observation.instruction))
        if tokens > longest:
            raise ValueError(
                f"instruction: expected at most {longest} tokens, got {tokens}: "
                f"{observation.instruction!r}"
            )
        # A tenth less time than without; the numbers are the same.
        with torch.inference_mode():
            chunks = self.policy.act(
                torch.from_numpy(np.array(observation.image)),
                torch.from_numpy(np.array(observation.state)),
                observation.instruction,
                draw.candidates,
                draw.temperature,
                torch.Generator().manual_seed(draw.seed),
            )
        return [world_from_model(chunk.double().numpy()).astype(np.float32) for chunk in chunks]


KINDS: dict[str, type[TokenPolicy] | type[FlowPolicy]] = {
    "openvla": TokenPolicy,
    "rever-flow": FlowPolicy,
}


def describe(folder: Path, temperature: float, side: int, statistics: Statistics) -> Description:
    """Both kinds are deterministic at temperature 0, and unscale actions by their quantiles."""
    spans = np.array(statistics.q99[:-1]) - np.array(statistics.q01[:-1])
    return Description(
        name=folder.resolve().name,
        digest=policy_server.digest_of(folder, FILES),
        temperature=temperature,
        is_greedy=True,
        image_size=(side, side),
        action_scale=[*spans.tolist(), GRIPPER_SPAN],
    )


def check_image(observation: Observation, description: Description) -> None:
    expected = (*description.image_size, 3)
    if observation.image.shape != expected:
        raise ValueError(f"image: expected {expected}, got {observation.image.shape}")


def read(folder: Path) -> TokenPolicy | FlowPolicy:
    """Loads a checkpoint of either kind. Raises ValueError for another kind."""
    missing = [name for name in FILES if not (folder / name).is_file()]
    if missing:
        raise ValueError(f"{folder}: expected {', '.join(FILES)}; missing: {', '.join(missing)}")
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    model_type = config.get("model_type")
    if model_type not in KINDS:
        expected = " or ".join(KINDS)
        raise ValueError(f"{folder}/config.json: expected model_type {expected}, got {model_type}")
    return KINDS[model_type](folder)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--model", type=Path, required=True, help="folder of the checkpoint")
    policy_server.Options.declare(parser)
    arguments = parser.parse_args()
    options = policy_server.Options.of(arguments)
    torch.set_num_threads(options.threads)
    try:
        policy = read(arguments.model)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    policy_server.serve(policy, options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
