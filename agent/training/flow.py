"""The network of bridge-flow, a small policy of pi0's kind: flow matching over chunks of actions.

    image -> vision tower of bridge-small, frozen -> patches ---+
    instruction -> embedding of its tokens ---------------------+-> prefix: attends to itself
    robot state -> one token, noise and time -> one token per action: they attend to the prefix
      and to each other
      -> velocity, integrated from noise (0) to actions (1) in a few Euler steps

As in pi0 (arXiv 2410.24164, section IV), prefix and actions have weights of their own in every
layer, the prefix never sees the actions, and its keys and values are computed once per chunk.
"""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

import checkpoint
from actions import DIMENSIONS, Statistics
from network import SIGLIP_NORMALISATION, RmsNorm, Tower, TowerConfig, attend, normalise
from tokenizer import Tokenizer

# Euler steps of the integration; pi0's number.
INTEGRATION_STEPS = 10
# Numbers of a robot state: x y z (m), roll pitch yaw (rad), 0, gripper opening 0..1.
STATE_NUMBERS = 8
# The shortest and longest period of the time embedding; pi0's numbers.
PERIODS = (4e-3, 4.0)


@dataclass(frozen=True)
class FlowConfig:
    """Sizes of the network; `vision` describes the frozen tower."""

    vision: TowerConfig
    vocabulary: int
    # Longest prompt in tokens.
    prompt: int
    # Actions of a chunk, one per control step.
    chunk: int = 4
    layers: int = 4
    heads: int = 4
    head_size: int = 64
    width: int = 256
    intermediate: int = 640
    action_width: int = 128
    action_intermediate: int = 384

    @classmethod
    def from_json(cls, value: dict[str, object]) -> FlowConfig:
        value = dict(value)
        vision = value.pop("vision")
        assert isinstance(vision, dict)
        return cls(vision=TowerConfig(**vision), **value)  # type: ignore[arg-type]


class Half(nn.Module):
    """One layer's weights for one kind of token.

    Of the last layer of the prefix only keys and values are used: it has no output.
    """

    def __init__(
        self, width: int, intermediate: int, heads: int, head_size: int, has_output: bool = True
    ) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = RmsNorm(width, 1e-6)
        self.qkv = nn.Linear(width, 3 * heads * head_size, bias=False)
        if not has_output:
            return
        self.o_proj = nn.Linear(heads * head_size, width, bias=False)
        self.norm2 = RmsNorm(width, 1e-6)
        self.gate_up = nn.Linear(width, 2 * intermediate, bias=False)
        self.down_proj = nn.Linear(intermediate, width, bias=False)

    def project(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(batch, length, width) -> query, key, value, each (batch, heads, length, head)."""
        batch, length, _ = x.shape
        qkv = self.qkv(self.norm1(x)).view(batch, length, 3, self.heads, -1)
        query, key, value = qkv.permute(2, 0, 3, 1, 4).unbind(0)
        return query, key, value

    def finish(self, x: Tensor, mixed: Tensor) -> Tensor:
        batch, length, _ = x.shape
        x = x + self.o_proj(mixed.transpose(1, 2).reshape(batch, length, -1))
        gate, up = self.gate_up(self.norm2(x)).chunk(2, dim=-1)
        result: Tensor = x + self.down_proj(functional.silu(gate) * up)
        return result


class FlowNetwork(nn.Module):
    """Everything behind the vision tower."""

    def __init__(self, config: FlowConfig) -> None:
        super().__init__()
        self.config = config
        width, action_width = config.width, config.action_width
        self.embed_tokens = nn.Embedding(config.vocabulary, width)
        self.pos_embed = nn.Parameter(torch.zeros(1, config.prompt, width))
        self.patches = nn.Linear(config.vision.embed_dim, width)
        sizes = (config.heads, config.head_size)
        self.prefix = nn.ModuleList(
            Half(width, config.intermediate, *sizes, has_output=index + 1 < config.layers)
            for index in range(config.layers)
        )
        self.actions = nn.ModuleList(
            Half(action_width, config.action_intermediate, *sizes) for _ in range(config.layers)
        )
        self.state_in = nn.Linear(STATE_NUMBERS, action_width)
        self.action_in = nn.Linear(DIMENSIONS, action_width)
        self.action_pos_embed = nn.Parameter(torch.zeros(1, config.chunk, action_width))
        self.time1 = nn.Linear(2 * action_width, action_width)
        self.time2 = nn.Linear(action_width, action_width)
        self.norm = RmsNorm(action_width, 1e-6)
        self.lm_head = nn.Linear(action_width, DIMENSIONS)
        for name, parameter in self.named_parameters():
            if parameter.ndim >= 2:
                nn.init.normal_(parameter, std=0.02)
                if name.endswith(("o_proj.weight", "down_proj.weight")):
                    with torch.no_grad():
                        parameter.mul_(1.0 / math.sqrt(2 * config.layers))

    def condition(self, features: Tensor, prompt: Tensor) -> list[tuple[Tensor, Tensor]]:
        """(batch, patches, vision width), (batch, prompt) -> keys and values of every layer."""
        words = self.embed_tokens(prompt) + self.pos_embed[:, : prompt.shape[1]]
        x = torch.cat([self.patches(features), words], dim=1)
        context = []
        for index, layer in enumerate(self.prefix):
            assert isinstance(layer, Half)
            query, key, value = layer.project(x)
            context.append((key, value))
            if index + 1 < len(self.prefix):
                x = layer.finish(x, attend(query, key, value, None))
        return context

    def velocity(
        self, context: list[tuple[Tensor, Tensor]], state: Tensor, noisy: Tensor, time: Tensor
    ) -> Tensor:
        """Scaled states (batch, 8), noisy actions (batch, chunk, 7), times (batch,) -> velocity.

        The batch may hold several chunks per entry of the context, one after the other.
        """
        embedded = embed_time(time, self.config.action_width)
        x = self.action_in(noisy)
        x = torch.cat([x, embedded[:, None].expand_as(x).to(x.dtype)], dim=-1)
        x = self.time2(functional.silu(self.time1(x))) + self.action_pos_embed
        x = torch.cat([self.state_in(state)[:, None], x], dim=1)
        for layer, (keys, values) in zip(self.actions, context, strict=True):
            assert isinstance(layer, Half)
            query, key, value = layer.project(x)
            repeats = len(x) // len(keys)
            key = torch.cat([keys.repeat_interleave(repeats, 0), key], dim=2)
            value = torch.cat([values.repeat_interleave(repeats, 0), value], dim=2)
            x = layer.finish(x, attend(query, key, value, None))
        result: Tensor = self.lm_head(self.norm(x[:, 1:]))
        return result

    @torch.no_grad()
    def sample(self, features: Tensor, prompt: Tensor, state: Tensor, noise: Tensor) -> Tensor:
        """Integrates (batch * samples, chunk, 7) noise to scaled actions of the same shape."""
        context = self.condition(features, prompt)
        x = noise
        for step in range(INTEGRATION_STEPS):
            time = torch.full((len(x),), step / INTEGRATION_STEPS)
            x = x + self.velocity(context, state, x, time) / INTEGRATION_STEPS
        return x


def embed_time(time: Tensor, width: int) -> Tensor:
    """Sine and cosine of (batch,) times at logarithmically spaced periods: (batch, width)."""
    shortest, longest = PERIODS
    share = torch.linspace(0.0, 1.0, width // 2)
    angles = time[:, None] * (2.0 * math.pi / (shortest * (longest / shortest) ** share))
    return torch.cat([angles.sin(), angles.cos()], dim=1)


@dataclass(frozen=True)
class FlowPolicy:
    """A policy as loaded from disk."""

    network: FlowNetwork
    vision: Tower
    tokenizer: Tokenizer
    statistics: Statistics
    # (8,) mean and standard deviation of the states in the demonstrations.
    state_mean: Tensor
    state_deviation: Tensor

    @torch.no_grad()
    def act(
        self,
        image: Tensor,
        state: Tensor,
        instruction: str,
        samples: int,
        temperature: float,
        generator: torch.Generator,
    ) -> Tensor:
        """(128, 128, 3) uint8 and (8,) -> (samples, chunk, 7) in OpenVLA's convention, unscaled.

        The temperature multiplies the initial noise; 0 gives the same chunk every time.
        """
        shape = (samples, self.network.config.chunk, DIMENSIONS)
        noise = temperature * torch.randn(shape, generator=generator)
        prompt = torch.tensor([self.tokenizer.prompt(instruction)])
        states = self.scale_state(state).expand(samples, -1)
        scaled = self.network.sample(see(self.vision, image[None]), prompt, states, noise)
        low, high = bounds(self.statistics)
        return 0.5 * (scaled.clip(-1.0, 1.0) + 1.0) * (high - low) + low

    def scale_state(self, state: Tensor) -> Tensor:
        """(..., 8) -> (..., 8) with mean 0 and deviation 1; a constant number becomes 0."""
        return (state - self.state_mean) / self.state_deviation.clamp(min=1e-3)


def see(tower: Tower, image: Tensor) -> Tensor:
    """(batch, height, width, 3) in 0..255 -> (batch, patches, vision width)."""
    pixels = image.permute(0, 3, 1, 2).float() / 255.0
    result: Tensor = tower(normalise(pixels, SIGLIP_NORMALISATION))
    return result


def bounds(statistics: Statistics) -> tuple[Tensor, Tensor]:
    """What -1 and 1 mean in each dimension: 1 % and 99 % quantile; closed and open gripper."""
    return torch.tensor(statistics.q01).float(), torch.tensor(statistics.q99).float()


def write(directory: Path, policy: FlowPolicy) -> None:
    """config.json, model.safetensors (bf16) and tokenizer.json, each atomically."""
    directory.mkdir(parents=True, exist_ok=True)
    config = {
        "model_type": "rever-flow",
        "network": dataclasses.asdict(policy.network.config),
        "statistics": policy.statistics.to_json(),
        "state": {
            "mean": policy.state_mean.tolist(),
            "std": policy.state_deviation.tolist(),
        },
    }
    checkpoint.replace(directory / "config.json", json.dumps(config, indent=2) + "\n")
    policy.tokenizer.save(directory / "tokenizer.json")
    module = whole(policy.network, policy.vision)
    checkpoint.write_weights(directory / "model.safetensors", module, torch.bfloat16)


def read(directory: Path) -> FlowPolicy:
    """Loads a policy; the weights are float32."""
    config = json.loads((directory / "config.json").read_text(encoding="utf-8"))
    network = FlowNetwork(FlowConfig.from_json(config["network"]))
    vision = Tower(network.config.vision, dead_blocks=0)
    weights = checkpoint.read_weights(directory / "model.safetensors")
    whole(network, vision).load_state_dict(weights)
    return FlowPolicy(
        network.eval(),
        vision.eval(),
        Tokenizer.load(directory / "tokenizer.json"),
        Statistics.from_json(config["statistics"]),
        torch.tensor(config["state"]["mean"]),
        torch.tensor(config["state"]["std"]),
    )


def whole(network: FlowNetwork, vision: Tower) -> nn.ModuleDict:
    """Network and tower under the names that they have in the file."""
    return nn.ModuleDict({"network": network, "vision": vision})
