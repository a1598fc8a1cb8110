"""Writes golden values, to test another implementation of the network against this one.

python agent/training/fixtures.py tiny    random small weights, output of every layer
python agent/training/fixtures.py shipped the trained model on recorded observations
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

import checkpoint
from actions import Statistics
from demonstration import Demonstration
from network import DecoderConfig, Network, NetworkConfig, TowerConfig
from tokenizer import END, Tokenizer

FIXTURES = Path(__file__).parents[1] / "tests" / "fixtures"
MODEL = Path(__file__).parents[1] / "models" / "bridge-small"
TOKENS_MAX = 48

TINY_PHRASES = [
    " TASK: put the spoon on the towel PLAN: reach the spoon, release it VISIBLE OBJECTS: spoon",
    ", towel",
    " SUBTASK REASONING: the spoon is not grasped yet SUBTASK: reach the spoon MOVE REASONING:"
    " the gripper must go to above the spoon",
    " MOVE: move left",
    " MOVE: move left down",
    " GRIPPER POSITION:",
    " ACTION:",
]
TINY_REASONING = (
    TINY_PHRASES[0] + " [10, 24, 36, 48], towel [60, 62, 90, 98]" + TINY_PHRASES[2]
    + " MOVE: move left down GRIPPER POSITION: [120, 84] ACTION:"
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("which", choices=["tiny", "shipped"])
    parser.add_argument("--demonstrations", type=Path, help="folder of held-out episodes")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.which == "tiny":
        for name, config in tiny_configs().items():
            write_tiny(FIXTURES / name, config, arguments.seed)
    else:
        write_shipped(FIXTURES / "bridge-small.safetensors", arguments.demonstrations)


def tiny_configs() -> dict[str, NetworkConfig]:
    """One vision tower, as in the shipped model; or two with all features of OpenVLA-7B's."""
    plain = TowerConfig(image_size=32, patch_size=8, embed_dim=24, depth=3, num_heads=3)
    dino = TowerConfig(
        image_size=28,
        patch_size=7,
        embed_dim=16,
        depth=3,
        num_heads=2,
        class_token=True,
        registers=4,
        layer_scale=True,
    )
    siglip = TowerConfig(
        image_size=28, patch_size=7, embed_dim=24, depth=3, num_heads=2, mlp_ratio=3.75
    )

    def text(key_value_heads: int) -> DecoderConfig:
        size = tiny_tokenizer().size + checkpoint.VOCABULARY_PADDING
        return DecoderConfig(32, 56, 2, 4, key_value_heads, size)

    return {
        "tiny": NetworkConfig(plain, text(4)),
        "tiny-fused": NetworkConfig(dino, text(2), fused_vision=siglip, dead_blocks=1),
    }


def tiny_tokenizer() -> Tokenizer:
    return Tokenizer.build(TINY_PHRASES, ["put the spoon on the towel"])


def write_tiny(directory: Path, config: NetworkConfig, seed: int) -> None:
    """Random weights, large enough that each layer changes the fourth digit of the output."""
    generator = torch.Generator().manual_seed(seed)
    network = Network(config).eval()
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            noise = torch.randn(parameter.shape, generator=generator)
            scale = 0.1 if parameter.ndim == 1 else 1.5 / parameter.shape[-1] ** 0.5
            centred = "norm" not in name and not name.endswith("scale_factor")
            centred = centred or name.endswith("bias")
            parameter.copy_(float(not centred) + scale * noise)
    # An arbitrary symmetric range in each scaled dimension.
    statistics = Statistics(
        q01=[-0.03, -0.04, -0.02, -0.1, -0.1, -0.2, 0.0],
        q99=[0.03, 0.04, 0.04, 0.1, 0.1, 0.2, 1.0],
        mean=[0.0] * 7,
        std=[1.0] * 7,
        min=[-1.0] * 7,
        max=[1.0] * 7,
    )
    tokenizer = tiny_tokenizer()
    checkpoint.write(directory, network, tokenizer, statistics, torch.float32)
    size = config.vision.image_size
    image = torch.randint(0, 256, (size, size, 3), generator=generator, dtype=torch.uint8)
    prompt = tokenizer.prompt("put the spoon on the towel")
    action = [tokenizer.action_id(digit) for digit in (1, 64, 128, 129, 200, 255, 256)]
    forced = [*tokenizer.encode(TINY_REASONING), *action, END]
    result = record_activations(network, image, [*prompt, *forced])
    result["prompt"] = torch.tensor(prompt)
    result["forced"] = torch.tensor(forced)
    result["greedy"] = torch.tensor(greedy(network, image, prompt))
    save_file(result, directory / "activations.safetensors")
    print(f"{directory}: {len(result)} tensors")


def record_activations(network: Network, image: Tensor, tokens: list[int]) -> dict[str, Tensor]:
    """Outputs of all blocks and layers by module name, without the batch dimension."""
    result: dict[str, Tensor] = {"image": image}
    decoder = network.language_model.model

    def keep(name: str) -> Callable[[nn.Module, tuple[Tensor, ...], Tensor], None]:
        def hook(module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
            result[name] = output[0].clone()

        return hook

    handles = []
    for name, module in network.named_modules():
        parts = name.split(".")
        is_layer = len(parts) > 1 and parts[-2] in ("blocks", "layers")
        if is_layer or parts[-1] in ("patch_embed", "featurizer", "fused_featurizer", "projector"):
            handles.append(module.register_forward_hook(keep(name)))
    handles.append(decoder.norm.register_forward_hook(keep("language_model.model.norm")))
    with torch.no_grad():
        result["logits"] = network(image[None], torch.tensor([tokens]))[0]
        result["embeddings"] = network.embed(image[None], torch.tensor([tokens]))[0]
    for handle in handles:
        handle.remove()
    return result


def greedy(network: Network, image: Tensor, prompt: list[int]) -> list[int]:
    """Greedy tokens without a cache, up to `</s>` or the limit."""
    tokens = list(prompt)
    with torch.no_grad():
        while len(tokens) - len(prompt) < TOKENS_MAX and tokens[-1] != END:
            logits = network(image[None], torch.tensor([tokens]))[0, -1]
            tokens.append(int(logits.argmax()))
    return tokens[len(prompt) :]


def write_shipped(path: Path, demonstrations: Path) -> None:
    """Two held-out observations of each task: an early one and one in mid-episode."""
    policy = checkpoint.read(MODEL)
    result: dict[str, Tensor] = {}
    metadata: dict[str, str] = {}
    index = 0
    for folder in sorted(item for item in demonstrations.iterdir() if item.is_dir()):
        file = max(folder.glob("*.npz"), key=lambda item: int(item.stem))
        episode = Demonstration.read(file)
        for frame in (2, len(episode.image) // 2):
            image = torch.from_numpy(np.array(episode.image[frame]))
            prompt = policy.tokenizer.prompt(episode.instruction)
            tokens = greedy(policy.network, image, prompt)
            # Logits of each generated token: from the last position of the prompt on.
            start = policy.network.config.vision.patches + len(prompt) - 1
            with torch.no_grad():
                sequence = torch.tensor([[*prompt, *tokens[:-1]]])
                hidden = policy.network.hidden(image[None], sequence, start)
                logits = policy.network.language_model.lm_head(hidden)
            result[f"{index}.image"] = image
            result[f"{index}.prompt"] = torch.tensor(prompt)
            result[f"{index}.greedy"] = torch.tensor(tokens)
            result[f"{index}.hidden"] = hidden[0].clone()
            result[f"{index}.logits"] = logits[0].clone()
            metadata[f"{index}.task"] = episode.task
            metadata[f"{index}.instruction"] = episode.instruction
            print(f"{file.stem} frame {frame}: {policy.tokenizer.decode(tokens)}")
            index += 1
    save_file(result, path, metadata={"observations": str(index), **metadata})


if __name__ == "__main__":
    main()
