"""Random weights of any size, written shard by shard; a full-size decoder, one layer at a time."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor
from transformers import LlamaConfig
from transformers.models.llama.modeling_llama import LlamaDecoderLayer, LlamaRMSNorm

from reference_network import Assembled, embed

INDEX = "model.safetensors.index.json"
LAYER = "language_model.model.layers."


def random_like(name: str, tensor: Tensor) -> Tensor:
    """Each layer changes its input about as much as a trained one; norms are near 1."""
    noise = torch.randn(tensor.shape)
    if tensor.ndim == 1:
        is_norm = "norm" in name and name.endswith("weight")
        is_scale = is_norm or name.endswith("scale_factor")
        return float(is_scale) + 0.1 * noise
    if name.endswith(("embed_tokens.weight", "cls_token", "reg_token", "latent")):
        return 0.5 * noise
    if name.endswith("pos_embed"):
        return 0.1 * noise
    return noise / math.sqrt(tensor[0].numel())


def write(folder: Path, config: dict[str, Any], shard_bytes: int) -> None:
    """Writes a full-size checkpoint; at most one shard and one layer are in memory."""
    one = {**config, "text_config": {**config["text_config"], "num_hidden_layers": 1}}
    shapes = {name: tensor.shape for name, tensor in Assembled(one).state_dict().items()}
    layers = LlamaConfig(**config["text_config"]).num_hidden_layers
    for name in [name for name in shapes if name.startswith(LAYER)]:
        for index in range(1, layers):
            shapes[name.replace(LAYER + "0", LAYER + str(index))] = shapes[name]
    shards: list[list[str]] = [[]]
    size = 0
    for name in sorted(shapes):
        bytes_ = 2 * shapes[name].numel()
        if size + bytes_ > shard_bytes and shards[-1]:
            shards.append([])
            size = 0
        shards[-1].append(name)
        size += bytes_
    weight_map = {}
    for index, names in enumerate(shards):
        file = f"model-{index + 1:05}-of-{len(shards):05}.safetensors"
        tensors = {}
        for name in names:
            tensors[name] = random_like(name, torch.empty(shapes[name])).bfloat16()
            weight_map[name] = file
        save_file(tensors, folder / file, metadata={"format": "pt"})
        print(f"{file}: {len(names)} tensors", flush=True)
    total = sum(2 * shape.numel() for shape in shapes.values())
    text = json.dumps({"metadata": {"total_size": total}, "weight_map": weight_map}, indent=2)
    (folder / INDEX).write_text(text + "\n", encoding="utf-8")


def read_all(folder: Path) -> dict[str, Tensor]:
    """All tensors in 32 bits."""
    weights = load_file(folder / "model.safetensors")
    return {name: tensor.float() for name, tensor in weights.items()}


def read(folder: Path, prefix: str) -> Iterator[tuple[str, Tensor]]:
    """The tensors with this prefix, without it, in 32 bits."""
    weight_map = json.loads((folder / INDEX).read_text(encoding="utf-8"))["weight_map"]
    for name, file in weight_map.items():
        if name.startswith(prefix):
            with safe_open(folder / file, "pt") as shard:
                yield name[len(prefix) :], shard.get_tensor(name).float()


def logits(
    folder: Path, config: dict[str, Any], image: Tensor, ids: list[int], start: int, fused: bool
) -> Tensor:
    """As `reference_network.logits`, with one decoder layer in memory at a time."""
    one = {**config, "text_config": {**config["text_config"], "num_hidden_layers": 1}}
    model = Assembled(one).eval()
    for part in ("vision_backbone", "projector"):
        getattr(model, part).load_state_dict(dict(read(folder, f"{part}.")))
    table = dict(read(folder, "language_model.model.embed_tokens."))
    model.language_model.get_input_embeddings().load_state_dict(table)
    rows = embed(model, image, ids, fused)
    del model, table
    text = LlamaConfig(**config["text_config"], attn_implementation="eager")
    count = rows.shape[1]
    mask = torch.full((count, count), torch.finfo(torch.float32).min).triu(1)[None, None]
    positions = torch.arange(count)[None]
    layer = LlamaDecoderLayer(text, 0).eval()
    for index in range(text.num_hidden_layers):
        layer.load_state_dict(dict(read(folder, f"{LAYER}{index}.")))
        rows = layer(rows, attention_mask=mask, position_ids=positions)[0]
    norm = LlamaRMSNorm(text.hidden_size, eps=text.rms_norm_eps)
    norm.load_state_dict(dict(read(folder, "language_model.model.norm.")))
    rows = norm(rows[0, -(len(ids) - start) - 1 :])
    ((_, head),) = read(folder, "language_model.lm_head.")
    return rows @ head.T


def action(ids: list[int], statistics: dict[str, Any], size: int, bins: int) -> np.ndarray:
    """predict_action's formula, then SIMPLER's: rotation vector, gripper -1 or 1."""
    edges = np.linspace(-1, 1, bins)
    centres = (edges[:-1] + edges[1:]) / 2
    normalised = centres[np.clip(size - np.array(ids) - 1, 0, len(centres) - 1)]
    low, high = np.array(statistics["q01"]), np.array(statistics["q99"])
    scaled = 0.5 * (normalised + 1) * (high - low) + low
    raw = np.where(statistics["mask"], scaled, normalised)
    (sr, sp, sy), (cr, cp, cy) = np.sin(raw[3:6]), np.cos(raw[3:6])
    turn_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    turn_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    turn_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    matrix = turn_z @ turn_y @ turn_x
    axis = np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )
    sine = np.linalg.norm(axis) / 2
    angle = np.arctan2(sine, (np.trace(matrix) - 1) / 2)
    rotation = axis * (0.5 if sine < 1e-12 else angle / (2 * sine))
    return np.concatenate([raw[:3], rotation, [1.0 if raw[6] > 0.5 else -1.0]])
