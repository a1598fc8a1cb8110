"""Reads and writes a checkpoint folder: config.json, model.safetensors, tokenizer.json."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from actions import Statistics
from network import DecoderConfig, Network, NetworkConfig, TowerConfig
from tokenizer import ACTION_BINS, BEGIN, END, PROMPT_TEMPLATE, Tokenizer

# OpenVLA's rule: rows of the embedding beyond the tokenizer's ids, 64 of them, are padding.
VOCABULARY_PADDING = 64
DATASET = "rever_bridge"


@dataclass(frozen=True)
class Checkpoint:
    """A policy as loaded from disk."""

    network: Network
    tokenizer: Tokenizer
    statistics: Statistics


def write(
    directory: Path,
    network: Network,
    tokenizer: Tokenizer,
    statistics: Statistics,
    dtype: torch.dtype,
) -> None:
    """Writes the three files, each atomically."""
    directory.mkdir(parents=True, exist_ok=True)
    config = config_json(network.config, statistics, dtype)
    replace(directory / "config.json", json.dumps(config, indent=2) + "\n")
    tokenizer.save(directory / "tokenizer.json")
    write_weights(directory / "model.safetensors", network, dtype)


def write_weights(path: Path, module: nn.Module, dtype: torch.dtype) -> None:
    """Writes all weights of a module, atomically."""
    weights = {
        name: tensor.detach().to(dtype).contiguous() for name, tensor in module.state_dict().items()
    }
    partial = path.with_name(path.name + ".partial")
    save_file(weights, partial, metadata={"format": "pt"})
    partial.replace(path)


def read_weights(path: Path) -> dict[str, Tensor]:
    """Reads weights in float32, whatever their type on disk."""
    return {name: tensor.float() for name, tensor in load_file(path).items()}


def read(directory: Path) -> Checkpoint:
    """Loads a checkpoint; the weights are float32."""
    config = json.loads((directory / "config.json").read_text(encoding="utf-8"))
    weights = read_weights(directory / "model.safetensors")
    network = Network(network_config(config, dead_blocks(config, weights)))
    network.load_state_dict(weights)
    action = config["norm_stats"][config["unnorm_key"]]["action"]
    statistics = Statistics.from_json(action)
    return Checkpoint(network.eval(), Tokenizer.load(directory / "tokenizer.json"), statistics)


def config_json(
    config: NetworkConfig, statistics: Statistics, dtype: torch.dtype
) -> dict[str, Any]:
    """OpenVLA's config.json, with full descriptions of vision towers that timm does not name."""
    fused = config.fused_vision is not None
    towers = [config.vision] + ([config.fused_vision] if config.fused_vision else [])
    text = {
        "model_type": "llama",
        "hidden_act": "silu",
        "tie_word_embeddings": False,
        "attention_bias": False,
        "bos_token_id": BEGIN,
        "eos_token_id": END,
        **dataclasses.asdict(config.text),
    }
    vision = {"vision_config": dataclasses.asdict(config.vision)}
    if config.fused_vision is not None:
        vision["fused_vision_config"] = dataclasses.asdict(config.fused_vision)
    return {
        "architectures": ["OpenVLAForActionPrediction"],
        "model_type": "openvla",
        "arch_specifier": "no-align+fused-gelu-mlp" if fused else "no-align+gelu-mlp",
        "vision_backbone_id": "rever-fused-vit" if fused else "rever-vit",
        "timm_model_ids": ["rever_vit"] * len(towers),
        "timm_override_act_layers": [None] * len(towers),
        "use_fused_vision_backbone": fused,
        "image_sizes": [tower.image_size for tower in towers],
        "image_resize_strategy": "resize-naive",
        **vision,
        "llm_backbone_id": "rever-llama",
        "text_config": text,
        "pad_token_id": 0,
        "pad_to_multiple_of": VOCABULARY_PADDING,
        "n_action_bins": ACTION_BINS,
        "torch_dtype": str(dtype).removeprefix("torch."),
        "prompt_template": PROMPT_TEMPLATE,
        "reasoning": True,
        # Its reasoning has one form: a text in another form is refused with its action.
        "reasoning_strict": True,
        "unnorm_key": DATASET,
        "norm_stats": {DATASET: {"action": statistics.to_json()}},
    }


def network_config(config: dict[str, Any], dead: int) -> NetworkConfig:
    fields = {field.name for field in dataclasses.fields(DecoderConfig)}
    text = {key: value for key, value in config["text_config"].items() if key in fields}
    fused = config.get("fused_vision_config")
    return NetworkConfig(
        vision=TowerConfig(**config["vision_config"]),
        text=DecoderConfig(**text),
        fused_vision=None if fused is None else TowerConfig(**fused),
        dead_blocks=dead,
    )


def dead_blocks(config: dict[str, Any], weights: dict[str, Tensor]) -> int:
    prefix = "vision_backbone.featurizer.blocks."
    present = {key[len(prefix) :].split(".")[0] for key in weights if key.startswith(prefix)}
    return len(present) - (int(config["vision_config"]["depth"]) - 1)


def replace(path: Path, text: str) -> None:
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)
