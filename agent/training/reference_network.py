"""OpenVLA's network from the packages that its authors use: timm's towers, transformers' Llama.

With the reference's own files, its class is used. Without them the same parts are put together
here; names of tensors and the order of computation are the reference's in both cases.
"""

from __future__ import annotations

import importlib
import sys
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import timm
import torch
from timm.models import VisionTransformer, register_model
from torch import Tensor, nn
from transformers import LlamaConfig, LlamaForCausalLM

FUSED_IDS = ["vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"]
SMALL_IDS = ["rever_small_reg4_dinov2", "rever_small_siglip"]
SMALL_SIDE = 56
# Of rever's config.json: what describes towers that it does not know by name.
SMALL_TOWERS = [
    {"embed_dim": 64, "depth": 4, "num_heads": 4, "mlp_ratio": 4.0, "class_token": True,
     "registers": 4, "layer_scale": True},
    {"embed_dim": 96, "depth": 5, "num_heads": 4, "mlp_ratio": 3.75, "class_token": False,
     "registers": 0, "layer_scale": False},
]  # fmt: skip
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
HALVES = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))


@dataclass(frozen=True)
class Kind:
    """One of the published families."""

    backbone: str
    llm: str
    fused: bool
    resize: str
    reasoning: bool
    prompt: str
    datasets: tuple[str, ...]


VICUNA = (
    "A chat between a curious user and an artificial intelligence assistant. The assistant gives"
    " helpful, detailed, and polite answers to the user's questions. USER: What action should the"
    " robot take to {instruction}? ASSISTANT:"
)
KINDS = {
    "openvla": Kind(
        "dinosiglip-vit-so-224px", "llama2-7b-pure", True, "resize-naive", False,
        "In: What action should the robot take to {instruction}?\nOut:",
        ("bridge_orig", "fractal20220817_data"),
    ),
    "ecot": Kind(
        "siglip-vit-so400m", "vicuna-v15-7b", False, "letterbox", True,
        VICUNA + " TASK:", ("bridge_orig",),
    ),
    "v01": Kind(
        "siglip-vit-so400m", "vicuna-v15-7b", False, "letterbox", False,
        VICUNA, ("bridge_orig",),
    ),
}  # fmt: skip


@register_model
def rever_small_reg4_dinov2(pretrained: bool = False, **given: Any) -> nn.Module:
    """A DINOv2 tower with registers and layer scale that a test can afford."""
    return small_tower(0, init_values=1e-5, reg_tokens=4, no_embed_class=True, **given)


@register_model
def rever_small_siglip(pretrained: bool = False, **given: Any) -> nn.Module:
    """A SigLIP tower that a test can afford."""
    return small_tower(1, class_token=False, global_pool="map", **given)


def small_tower(index: int, **given: Any) -> nn.Module:
    names = ("img_size", "num_classes", "act_layer", "init_values", "reg_tokens", "class_token",
             "no_embed_class", "global_pool")  # fmt: skip
    options = {name: value for name, value in given.items() if name in names}
    shape = SMALL_TOWERS[index]
    sizes = {name: shape[name] for name in ("embed_dim", "depth", "num_heads", "mlp_ratio")}
    return VisionTransformer(patch_size=14, **sizes, **options)


class VisionBackbone(nn.Module):
    """The towers, with the output of the last but one block."""

    def __init__(self, ids: list[str], side: int) -> None:
        super().__init__()
        names = ("featurizer", "fused_featurizer")[: len(ids)]
        for name, identifier in zip(names, ids, strict=True):
            tower = timm.create_model(identifier, pretrained=False, num_classes=0, img_size=side)
            for module in tower.modules():
                # transformers rewrites names with `gamma`, so OpenVLA's files have another one.
                if isinstance(module, timm.models.vision_transformer.LayerScale):
                    module.scale_factor = nn.Parameter(module.gamma.clone())
                    module.forward = lambda x, module=module: x * module.scale_factor
                    del module.gamma
            self.add_module(name, tower)
        self.width = sum(getattr(self, name).embed_dim for name in names)
        self.names = names

    def forward(self, pixels: Tensor) -> Tensor:
        """(images, 3 x towers, side, side) -> (images, patches, width of all towers)"""
        features = []
        for name, part in zip(self.names, pixels.split(3, dim=1), strict=True):
            tower = getattr(self, name)
            features.append(tower.get_intermediate_layers(part, n={len(tower.blocks) - 2})[0])
        return torch.cat(features, dim=2)


class Projector(nn.Module):
    """Two layers, or three for fused towers, with GELU between them."""

    def __init__(self, width: int, hidden: int, fused: bool) -> None:
        super().__init__()
        widths = [width, 4 * width, hidden, hidden] if fused else [width, hidden, hidden]
        for index in range(len(widths) - 1):
            self.add_module(f"fc{index + 1}", nn.Linear(widths[index], widths[index + 1]))
        self.count = len(widths) - 1

    def forward(self, rows: Tensor) -> Tensor:
        for index in range(self.count):
            if index > 0:
                rows = nn.functional.gelu(rows)
            rows = getattr(self, f"fc{index + 1}")(rows)
        return rows


class Assembled(nn.Module):
    """The same parts as in the reference's class, under the same names."""

    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__()
        fused = config["use_fused_vision_backbone"]
        self.vision_backbone = VisionBackbone(config["timm_model_ids"], config["image_sizes"][0])
        text = LlamaConfig(**config["text_config"])
        self.projector = Projector(self.vision_backbone.width, text.hidden_size, fused)
        self.language_model = LlamaForCausalLM(text)


def assemble(config: dict[str, Any], reference: Path | None) -> nn.Module:
    """The reference's class where its files are given, else the same parts; random weights."""
    if reference is None:
        return Assembled(config).eval()
    # The reference's package imports what training needs; these files stand alone.
    package = types.ModuleType("openvla_reference")
    package.__path__ = [str(reference / "prismatic" / "extern" / "hf")]
    sys.modules["openvla_reference"] = package
    classes = importlib.import_module("openvla_reference.modeling_prismatic")
    own = ("timm_model_ids", "timm_override_act_layers", "image_sizes")
    fields = (
        "vision_backbone_id", "llm_backbone_id", "arch_specifier", "use_fused_vision_backbone",
        "image_resize_strategy", "text_config", "norm_stats", "n_action_bins", "pad_token_id",
        "pad_to_multiple_of",
    )  # fmt: skip
    options = classes.OpenVLAConfig(**{name: config[name] for name in fields})
    for name in own:
        setattr(options, name, config[name])
    model: nn.Module = classes.OpenVLAForActionPrediction(options)
    return model.eval()


def pixels(image: Tensor, fused: bool) -> Tensor:
    """(height, width, 3) bytes -> (1, 3 x towers, height, width), normalised for each tower."""
    scaled = image.permute(2, 0, 1)[None].float() / 255.0
    towers = (IMAGENET, HALVES) if fused else (HALVES,)
    parts = []
    for mean, deviation in towers:
        shape = (1, 3, 1, 1)
        parts.append(
            (scaled - torch.tensor(mean).view(shape)) / torch.tensor(deviation).view(shape)
        )
    return torch.cat(parts, dim=1)


def embed(model: nn.Module, image: Tensor, ids: list[int], fused: bool) -> Tensor:
    """The first token, the projected patches, the other tokens: (1, positions, hidden)"""
    table = model.language_model.get_input_embeddings()
    patches = model.projector(model.vision_backbone(pixels(image, fused)))
    words = table(torch.tensor([ids]))
    return torch.cat([words[:, :1], patches, words[:, 1:]], dim=1)


def logits(model: nn.Module, image: Tensor, ids: list[int], start: int, fused: bool) -> Tensor:
    """Logits that predict the tokens from `start` on, and the one after the last."""
    if hasattr(model, "predict_action"):
        output = model(input_ids=torch.tensor([ids]), pixel_values=pixels(image, fused))
        rows: Tensor = output.logits[0]
    else:
        rows = model.language_model(inputs_embeds=embed(model, image, ids, fused)).logits[0]
    return rows[len(rows) - (len(ids) - start) - 1 :]
