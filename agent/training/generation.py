"""Batched generation with a key-value cache, to measure a checkpoint from Python."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import checkpoint
from actions import DIMENSIONS, actions_from_digits, world_from_model
from network import Decoder, DecoderLayer, Network, SelfAttention, attend, rotary_table, rotate
from tokenizer import ACTION_BINS, END

# Reasoning of 17 tokens, 7 action tokens and `</s>`.
COMPLETION_TOKENS = 25


@dataclass
class Cache:
    """Keys and values of every layer: layers x (batch, heads, positions_max, head)."""

    keys: list[Tensor]
    values: list[Tensor]
    length: int

    @classmethod
    def empty(cls, decoder: Decoder, batch: int, positions_max: int) -> Cache:
        config = decoder.config
        shape = (batch, config.num_key_value_heads, positions_max, config.head_size)
        layers = range(config.num_hidden_layers)
        return cls([torch.zeros(shape) for _ in layers], [torch.zeros(shape) for _ in layers], 0)


@torch.no_grad()
def generate(
    network: Network,
    image: Tensor,
    prompt: Tensor,
    tokens: int,
    temperature: float,
    generator: torch.Generator,
) -> Tensor:
    """(batch, height, width, 3) and (batch, prompt) -> (batch, tokens); temperature 0 is greedy.

    Always samples `tokens` tokens: all completions of a policy have the same length.
    """
    decoder = network.language_model.model
    embedded = network.embed(image, prompt)
    cache = Cache.empty(decoder, len(image), embedded.shape[1] + tokens)
    result = []
    for _ in range(tokens):
        hidden = extend(decoder, cache, embedded)
        logits = network.language_model.lm_head(hidden[:, -1])
        if temperature == 0.0:
            chosen = logits.argmax(-1)
        else:
            shares = torch.softmax(logits / temperature, dim=-1)
            chosen = torch.multinomial(shares, 1, generator=generator)[:, 0]
        result.append(chosen)
        embedded = decoder.embed_tokens(chosen)[:, None]
    return torch.stack(result, dim=1)


def extend(decoder: Decoder, cache: Cache, x: Tensor) -> Tensor:
    """(batch, new positions, hidden) -> final-norm states; appends the positions to the cache."""
    first, last = cache.length, cache.length + x.shape[1]
    cosine, sine = rotary_table(last, decoder.config, x.device)
    mask = torch.full((last, last), -torch.inf).triu(1)[first:]
    for index, layer in enumerate(decoder.layers):
        assert isinstance(layer, DecoderLayer)
        normed = layer.input_layernorm(x)
        x = x + attend_cached(
            layer.self_attn, normed, (cosine[first:], sine[first:]), mask, cache, index
        )
        x = x + layer.mlp(layer.post_attention_layernorm(x))
    cache.length = last
    result: Tensor = decoder.norm(x)
    return result


def attend_cached(
    attention: SelfAttention,
    x: Tensor,
    rotary: tuple[Tensor, Tensor],
    mask: Tensor,
    cache: Cache,
    index: int,
) -> Tensor:
    batch, length, width = x.shape
    config = attention.config
    shape = (batch, length, -1, config.head_size)
    # (batch, length, heads * head) -> (batch, heads, length, head)
    query = rotate(attention.q_proj(x).view(shape).transpose(1, 2), *rotary)
    key = rotate(attention.k_proj(x).view(shape).transpose(1, 2), *rotary)
    first, last = cache.length, cache.length + length
    cache.keys[index][:, :, first:last] = key
    cache.values[index][:, :, first:last] = attention.v_proj(x).view(shape).transpose(1, 2)
    groups = config.num_attention_heads // config.num_key_value_heads
    keys = cache.keys[index][:, :, :last].repeat_interleave(groups, dim=1)
    values = cache.values[index][:, :, :last].repeat_interleave(groups, dim=1)
    mixed = attend(query, keys, values, mask)
    # (batch, heads, length, head) -> (batch, length, width)
    result: Tensor = attention.o_proj(mixed.transpose(1, 2).reshape(batch, length, width))
    return result


def decode(
    policy: checkpoint.Checkpoint, completion: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Actions in the environment's convention; a malformed completion holds still, gripper open."""
    size = policy.tokenizer.size
    digits = size - completion[:, -1 - DIMENSIONS : -1]
    inside = ((digits >= 1) & (digits <= ACTION_BINS)).all(axis=1)
    well_formed = inside & (completion[:, -1] == END)
    actions = world_from_model(
        actions_from_digits(np.clip(digits, 1, ACTION_BINS), policy.statistics)
    )
    actions[~well_formed] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    return actions, well_formed
