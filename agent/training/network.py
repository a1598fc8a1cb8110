"""The OpenVLA/Prismatic network at any size: vision transformer, projector, Llama decoder.

Module names are the checkpoint's keys, so `state_dict()` is the file format. Data flow:

    image (batch, height, width, 3) uint8
      -> vision_backbone: output of the second-to-last block, no final norm
      -> projector: (batch, patches, hidden)
      -> decoder over [first token, patches, other tokens], causal over everything
      -> final-norm states, logits
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

# Means and deviations of the channels in 0..1, from the 7 B checkpoints.
SIGLIP_NORMALISATION = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
DINO_NORMALISATION = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))

LAYER_NORM_EPSILON = 1e-6  # timm's value for both towers of OpenVLA, not PyTorch's default.


@dataclass(frozen=True)
class TowerConfig:
    """One vision transformer; field names are those of `vision_config` in config.json."""

    image_size: int
    patch_size: int
    embed_dim: int
    depth: int
    num_heads: int
    mlp_ratio: float = 4.0
    class_token: bool = False
    registers: int = 0
    layer_scale: bool = False

    @property
    def patches(self) -> int:
        return (self.image_size // self.patch_size) ** 2

    @property
    def prefix_tokens(self) -> int:
        return int(self.class_token) + self.registers


@dataclass(frozen=True)
class DecoderConfig:
    """The Llama decoder; field names are those of `text_config` in config.json."""

    hidden_size: int
    intermediate_size: int
    num_hidden_layers: int
    num_attention_heads: int
    num_key_value_heads: int
    vocab_size: int
    rms_norm_eps: float = 1e-6
    rope_theta: float = 10000.0
    max_position_embeddings: int = 256

    @property
    def head_size(self) -> int:
        return self.hidden_size // self.num_attention_heads


@dataclass(frozen=True)
class NetworkConfig:
    """The whole network: one vision tower, or two, the first of them DINO-like (fused)."""

    vision: TowerConfig
    text: DecoderConfig
    fused_vision: TowerConfig | None = None
    # Unused; checkpoints may have them anyway, as OpenVLA's do.
    dead_blocks: int = 0


class Attention(nn.Module):
    """timm's attention: one fused and biased query-key-value projection."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        batch, length, width = x.shape
        # (batch, length, 3 * width) -> 3 x (batch, heads, length, head)
        qkv = self.qkv(x).view(batch, length, 3, self.heads, width // self.heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4).unbind(0)
        mixed = attend(query, key, value, None)
        # (batch, heads, length, head) -> (batch, length, width)
        x = self.proj(mixed.transpose(1, 2).reshape(x.shape))
        return x


class Mlp(nn.Module):
    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        x = self.fc2(functional.gelu(self.fc1(x)))
        return x


class LayerScale(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.full((width,), 1e-5))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale_factor


class Block(nn.Module):
    """A pre-norm transformer block of the vision tower."""

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        width = config.embed_dim
        self.norm1 = nn.LayerNorm(width, eps=LAYER_NORM_EPSILON)
        self.attn = Attention(width, config.num_heads)
        self.ls1: nn.Module = LayerScale(width) if config.layer_scale else nn.Identity()
        self.norm2 = nn.LayerNorm(width, eps=LAYER_NORM_EPSILON)
        self.mlp = Mlp(width, round(width * config.mlp_ratio))
        self.ls2: nn.Module = LayerScale(width) if config.layer_scale else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        x = x + self.ls2(self.mlp(self.norm2(x)))
        return x


class PatchEmbed(nn.Module):
    """A linear map of each patch, stored as a convolution, as in timm."""

    def __init__(self, config: TowerConfig) -> None:
        super().__init__()
        self.patch_size = config.patch_size
        self.proj = nn.Conv2d(3, config.embed_dim, config.patch_size, config.patch_size)

    def forward(self, pixels: Tensor) -> Tensor:
        size = self.patch_size
        batch, channels, height, width = pixels.shape
        rows, columns = height // size, width // size
        # (batch, 3, rows * size, columns * size) -> (batch, rows * columns, 3 * size * size)
        patches = pixels.view(batch, channels, rows, size, columns, size)
        patches = patches.permute(0, 2, 4, 1, 3, 5).reshape(batch, rows * columns, -1)
        return functional.linear(patches, self.proj.weight.flatten(1), self.proj.bias)


class Tower(nn.Module):
    """timm's vision transformer up to its second-to-last block."""

    def __init__(self, config: TowerConfig, dead_blocks: int) -> None:
        super().__init__()
        self.config = config
        width = config.embed_dim
        if config.class_token:
            self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        if config.registers:
            self.reg_token = nn.Parameter(torch.zeros(1, config.registers, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, config.patches, width))
        self.patch_embed = PatchEmbed(config)
        self.blocks_used = config.depth - 1
        self.blocks = nn.ModuleList(Block(config) for _ in range(self.blocks_used + dead_blocks))
        if dead_blocks:
            self.norm = nn.LayerNorm(width, eps=LAYER_NORM_EPSILON)

    def forward(self, pixels: Tensor) -> Tensor:
        x = self.patch_embed(pixels) + self.pos_embed
        prefix = []
        if self.config.class_token:
            prefix.append(self.cls_token.expand(x.shape[0], -1, -1))
        if self.config.registers:
            prefix.append(self.reg_token.expand(x.shape[0], -1, -1))
        if prefix:
            x = torch.cat([*prefix, x], dim=1)
        for block in self.blocks[: self.blocks_used]:
            x = block(x)
        result: Tensor = x[:, self.config.prefix_tokens :]
        return result


class VisionBackbone(nn.Module):
    """One tower, or two with concatenated features, DINO's first."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.featurizer = Tower(config.vision, config.dead_blocks)
        self.fused_featurizer = (
            None if config.fused_vision is None else Tower(config.fused_vision, config.dead_blocks)
        )

    def forward(self, image: Tensor) -> Tensor:
        # (batch, height, width, 3) in 0..255 -> (batch, 3, height, width) in 0..1
        pixels = image.permute(0, 3, 1, 2).float() / 255.0
        if self.fused_featurizer is None:
            first: Tensor = self.featurizer(normalise(pixels, SIGLIP_NORMALISATION))
            return first
        return torch.cat(
            [
                self.featurizer(normalise(pixels, DINO_NORMALISATION)),
                self.fused_featurizer(normalise(pixels, SIGLIP_NORMALISATION)),
            ],
            dim=2,
        )


class Projector(nn.Module):
    """Two layers for one tower; three for fused towers, the first four times wider."""

    def __init__(self, vision_width: int, hidden: int, fused: bool) -> None:
        super().__init__()
        first = 4 * vision_width if fused else hidden
        self.fc1 = nn.Linear(vision_width, first)
        self.fc2 = nn.Linear(first, hidden)
        self.fc3 = nn.Linear(hidden, hidden) if fused else None

    def forward(self, x: Tensor) -> Tensor:
        x = self.fc2(functional.gelu(self.fc1(x)))
        if self.fc3 is not None:
            x = self.fc3(functional.gelu(x))
        return x


class RmsNorm(nn.Module):
    def __init__(self, width: int, epsilon: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.epsilon = epsilon

    def forward(self, x: Tensor) -> Tensor:
        return x * torch.rsqrt(x.square().mean(-1, keepdim=True) + self.epsilon) * self.weight


class SelfAttention(nn.Module):
    """Llama's attention: rotary positions in halves, grouped keys and values."""

    def __init__(self, config: DecoderConfig) -> None:
        super().__init__()
        self.config = config
        key_width = config.num_key_value_heads * config.head_size
        self.q_proj = nn.Linear(config.hidden_size, config.hidden_size, bias=False)
        self.k_proj = nn.Linear(config.hidden_size, key_width, bias=False)
        self.v_proj = nn.Linear(config.hidden_size, key_width, bias=False)
        self.o_proj = nn.Linear(config.hidden_size, config.hidden_size, bias=False)

    def forward(self, x: Tensor, rotary: tuple[Tensor, Tensor], mask: Tensor, start: int) -> Tensor:
        """Outputs of the positions from `start` on; all positions are keys and values."""
        batch, length, width = x.shape
        head = self.config.head_size
        cosine, sine = rotary
        # (batch, length, heads * head) -> (batch, heads, length, head)
        query = self.q_proj(x[:, start:]).view(batch, length - start, -1, head).transpose(1, 2)
        key = self.k_proj(x).view(batch, length, -1, head).transpose(1, 2)
        value = self.v_proj(x).view(batch, length, -1, head).transpose(1, 2)
        query = rotate(query, cosine[start:], sine[start:])
        key = rotate(key, cosine, sine)
        groups = self.config.num_attention_heads // self.config.num_key_value_heads
        if groups > 1:
            key = key.repeat_interleave(groups, dim=1)
            value = value.repeat_interleave(groups, dim=1)
        mixed = attend(query, key, value, mask[start:])
        # (batch, heads, length - start, head) -> (batch, length - start, width)
        result: Tensor = self.o_proj(mixed.transpose(1, 2).reshape(batch, length - start, width))
        return result


class GatedMlp(nn.Module):
    def __init__(self, config: DecoderConfig) -> None:
        super().__init__()
        self.gate_proj = nn.Linear(config.hidden_size, config.intermediate_size, bias=False)
        self.up_proj = nn.Linear(config.hidden_size, config.intermediate_size, bias=False)
        self.down_proj = nn.Linear(config.intermediate_size, config.hidden_size, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        x = self.down_proj(functional.silu(self.gate_proj(x)) * self.up_proj(x))
        return x


class DecoderLayer(nn.Module):
    def __init__(self, config: DecoderConfig) -> None:
        super().__init__()
        self.self_attn = SelfAttention(config)
        self.mlp = GatedMlp(config)
        self.input_layernorm = RmsNorm(config.hidden_size, config.rms_norm_eps)
        self.post_attention_layernorm = RmsNorm(config.hidden_size, config.rms_norm_eps)

    def forward(self, x: Tensor, rotary: tuple[Tensor, Tensor], mask: Tensor, start: int) -> Tensor:
        x = x[:, start:] + self.self_attn(self.input_layernorm(x), rotary, mask, start)
        result: Tensor = x + self.mlp(self.post_attention_layernorm(x))
        return result


class Decoder(nn.Module):
    def __init__(self, config: DecoderConfig) -> None:
        super().__init__()
        self.config = config
        self.embed_tokens = nn.Embedding(config.vocab_size, config.hidden_size)
        self.layers = nn.ModuleList(DecoderLayer(config) for _ in range(config.num_hidden_layers))
        self.norm = RmsNorm(config.hidden_size, config.rms_norm_eps)

    def forward(self, x: Tensor, start: int) -> Tensor:
        """(batch, length, hidden) -> final-norm states of the positions from `start` on."""
        length = x.shape[1]
        rotary = rotary_table(length, self.config, x.device)
        mask = torch.full((length, length), -torch.inf, device=x.device).triu(1)
        last = len(self.layers) - 1
        for index, layer in enumerate(self.layers):
            # Nothing after the last layer mixes positions: it computes only the requested ones.
            x = layer(x, rotary, mask, start if index == last else 0)
        result: Tensor = self.norm(x)
        return result


class LanguageModel(nn.Module):
    def __init__(self, config: DecoderConfig) -> None:
        super().__init__()
        self.model = Decoder(config)
        self.lm_head = nn.Linear(config.hidden_size, config.vocab_size, bias=False)


class Network(nn.Module):
    """The whole policy network."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        fused = config.fused_vision
        vision_width = config.vision.embed_dim + (0 if fused is None else fused.embed_dim)
        self.vision_backbone = VisionBackbone(config)
        self.projector = Projector(vision_width, config.text.hidden_size, fused is not None)
        self.language_model = LanguageModel(config.text)
        initialise(self, config)

    def embed(self, image: Tensor, tokens: Tensor) -> Tensor:
        """(batch, height, width, 3) and (batch, tokens) -> (batch, patches + tokens, hidden)."""
        patches = self.projector(self.vision_backbone(image))
        words = self.language_model.model.embed_tokens(tokens)
        return torch.cat([words[:, :1], patches, words[:, 1:]], dim=1)

    def hidden(self, image: Tensor, tokens: Tensor, start: int = 0) -> Tensor:
        """Final-norm states of the positions from `start` on (patches count as positions)."""
        result: Tensor = self.language_model.model(self.embed(image, tokens), start)
        return result

    def forward(self, image: Tensor, tokens: Tensor, start: int = 0) -> Tensor:
        result: Tensor = self.language_model.lm_head(self.hidden(image, tokens, start))
        return result


def attend(query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None) -> Tensor:
    """Plain attention: on a CPU its backward pass is faster than the fused kernel's."""
    scores = query @ key.transpose(2, 3) * (1.0 / math.sqrt(query.shape[-1]))
    if mask is not None:
        scores = scores + mask
    return torch.softmax(scores, dim=-1) @ value


def rotary_table(length: int, config: DecoderConfig, device: torch.device) -> tuple[Tensor, Tensor]:
    """Cosine and sine, (length, head); the same angles for both halves of a head."""
    steps = torch.arange(0, config.head_size, 2, device=device).float() / config.head_size
    angles = torch.outer(
        torch.arange(length, device=device).float(), 1.0 / config.rope_theta**steps
    )
    angles = torch.cat([angles, angles], dim=1)
    return angles.cos(), angles.sin()


def rotate(x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    first, second = x.chunk(2, dim=-1)
    return x * cosine + torch.cat([-second, first], dim=-1) * sine


def normalise(pixels: Tensor, normalisation: tuple[tuple[float, ...], tuple[float, ...]]) -> Tensor:
    mean, deviation = (torch.tensor(v, device=pixels.device) for v in normalisation)
    return (pixels - mean.view(3, 1, 1)) / deviation.view(3, 1, 1)


def initialise(network: Network, config: NetworkConfig) -> None:
    """Normal weights, deviation 0.02; the last ones of residual branches are scaled by depth."""
    depths = (config.vision.depth, config.text.num_hidden_layers)
    for name, parameter in network.named_parameters():
        if name.endswith("bias"):
            nn.init.zeros_(parameter)
        elif parameter.ndim >= 2:
            nn.init.normal_(parameter, std=0.02)
        if name.endswith((".proj.weight", "fc2.weight", "o_proj.weight", "down_proj.weight")) and (
            "blocks" in name or "layers" in name
        ):
            depth = depths[0 if "blocks" in name else 1]
            with torch.no_grad():
                parameter.mul_(1.0 / math.sqrt(2 * depth))
