"""Builds checkpoints with OpenVLA's own packages and random weights, and compares rever with them.

python agent/training/reference.py build FOLDER --kind openvla --size small
python agent/training/reference.py compare FOLDER --rever target/release/rever -- OPTIONS OF REVER

Kinds: openvla (DINOv2 + SigLIP, Llama), ecot (SigLIP, Vicuna's prompt, reasoning), v01 (SigLIP,
Vicuna's prompt). Sizes: small (small towers and decoder), real-towers (the towers' real sizes), 7b
(everything, 15 GB of disk). With `--reference`, a clone of openvla/openvla, the network is the
reference's class; without it, timm's towers and transformers' Llama are put together here.

Small decoders are fitted to a few observations first, so that they write well-formed completions.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from transformers import LlamaTokenizerFast

import reference_layers
import reference_tokenizer as llama
from reference_network import (
    FUSED_IDS,
    KINDS,
    SMALL_IDS,
    SMALL_SIDE,
    SMALL_TOWERS,
    Kind,
    assemble,
    embed,
    logits,
)

ACTIONS = 7
BINS = 256
INSTRUCTIONS = ["Put spoon on towel", "put carrot on plate", "stack green cube on yellow cube"]
# Completions of the ecot kind, up to the action.
REASONING = (
    "Put the spoon on the towel PLAN: move the gripper to the spoon VISIBLE OBJECTS: spoon"
    " [{0}, 24, 36, 48], towel [60, 62, 90, 98] SUBTASK REASONING: the spoon is not grasp SUBTASK:"
    " reach the spoon MOVE REASONING: the gripper is above MOVE: move left down GRIPPER POSITION:"
    " [120, 84] ACTION:"
)
FIT_STEPS_MAX = 400
# Both sides in 32 bits.
TOLERANCE = 1e-3
ACTION_TOLERANCE = 1e-6
# The difference where rever has an action without seven action tokens.
NO_ACTION = 1e9
SHARD_BYTES = 2_000_000_000
SMALL_TEXT = {
    "hidden_size": 64, "intermediate_size": 160, "num_hidden_layers": 2, "num_attention_heads": 4,
}  # fmt: skip
# As published: what is missing has the default of transformers' LlamaConfig, which is the 7B.
PUBLISHED_TEXT: dict[str, Any] = {"model_type": "llama", "pad_token_id": llama.PAD}
Q01 = [-0.0287, -0.0417, -0.0261, -0.0809, -0.0929, -0.2072, 0.0]
Q99 = [0.0283, 0.0409, 0.0402, 0.0819, 0.0779, 0.2038, 1.0]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    build_ = commands.add_parser("build", help="write a checkpoint with random weights")
    build_.add_argument("folder", type=Path)
    build_.add_argument("--kind", choices=sorted(KINDS), default="openvla")
    build_.add_argument("--size", choices=["small", "real-towers", "7b"], default="small")
    build_.add_argument("--tokenizer", type=Path, help="Llama's tokenizer.json [a stand-in]")
    build_.add_argument("--seed", type=int, default=0)
    compare_ = commands.add_parser("compare", help="compare rever with the reference")
    compare_.add_argument("folder", type=Path)
    compare_.add_argument("--rever", type=Path, required=True, help="the program")
    compare_.add_argument(
        "--tolerance",
        type=float,
        default=TOLERANCE,
        help="largest difference of logits, relative to their standard deviation",
    )
    compare_.add_argument("--json", type=Path, help="also write the figures to this file")
    for one in (build_, compare_):
        one.add_argument("--reference", type=Path, help="a clone of openvla/openvla")
    words = sys.argv[1:]
    end = words.index("--") if "--" in words else len(words)
    arguments = parser.parse_args(words[:end])
    arguments.options = words[end + 1 :]
    # Two threads that share a busy core wait for each other longer than they compute.
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // 2))
    if arguments.command == "build":
        build(arguments)
    elif not compare(arguments):
        sys.exit(1)


def build(arguments: argparse.Namespace) -> None:
    """Writes config.json, tokenizer.json, the weights, and observations.safetensors."""
    torch.manual_seed(arguments.seed)
    kind, folder = KINDS[arguments.kind], arguments.folder
    folder.mkdir(parents=True, exist_ok=True)
    config = config_json(kind, arguments.size)
    text = json.dumps(config, indent=2) + "\n"
    (folder / "config.json").write_text(text, encoding="utf-8")
    llama.write(folder / "tokenizer.json", arguments.tokenizer)
    images = write_observations(folder, config["image_sizes"][0])
    if arguments.size == "7b":
        reference_layers.write(folder, config, SHARD_BYTES)
        print(f"{folder}: {arguments.kind}, full size, random weights")
        return
    model = assemble(config, arguments.reference)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            parameter.copy_(reference_layers.random_like(name, parameter))
    steps = fit(model, kind, images, tokenizer_of(folder))
    # A comparison loads what is in the file: numbers of 16 bits.
    weights = {name: tensor.bfloat16() for name, tensor in model.state_dict().items()}
    save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})
    source = "the reference's class" if arguments.reference else "timm and transformers"
    count = sum(tensor.numel() for tensor in weights.values())
    print(f"{folder}: {arguments.kind}, {count / 1e6:.1f} M, {source}, fitted in {steps} steps")


def config_json(kind: Kind, size: str) -> dict[str, Any]:
    """OpenVLA's fields; towers that only this program knows are described for rever."""
    small = size == "small"
    ids = (SMALL_IDS if small else FUSED_IDS)[0 if kind.fused else 1 :]
    text = {**PUBLISHED_TEXT, "vocab_size": llama.SIZE + 64}
    if size != "7b":
        text.update(SMALL_TEXT)
    side = SMALL_SIDE if small else 224
    action = {"q01": Q01, "q99": Q99, "mask": [True] * 6 + [False]}
    config = {
        "architectures": ["OpenVLAForActionPrediction"],
        "model_type": "openvla",
        "arch_specifier": "no-align+fused-gelu-mlp" if kind.fused else "no-align+gelu-mlp",
        "vision_backbone_id": kind.backbone,
        "llm_backbone_id": kind.llm,
        "timm_model_ids": ids,
        "timm_override_act_layers": [None] * len(ids),
        "use_fused_vision_backbone": kind.fused,
        "image_sizes": [side] * len(ids),
        "image_resize_strategy": kind.resize,
        "text_config": text,
        "pad_token_id": llama.PAD,
        "pad_to_multiple_of": 64,
        "n_action_bins": BINS,
        "torch_dtype": "bfloat16",
        "norm_stats": {name: {"action": action} for name in kind.datasets},
    }
    if small:
        towers = SMALL_TOWERS[0 if kind.fused else 1 :]
        for name, tower in zip(("vision_config", "fused_vision_config"), towers, strict=False):
            config[name] = {"image_size": side, "patch_size": 14, **tower}
    return config


def write_observations(folder: Path, side: int) -> list[Tensor]:
    """Images of coloured rectangles, with instructions, in the form that rever reads."""
    tensors, metadata = {}, {"observations": str(len(INSTRUCTIONS))}
    for index, instruction in enumerate(INSTRUCTIONS):
        image = torch.randint(0, 256, (4, 4, 3), dtype=torch.uint8)
        image = image.repeat_interleave(side // 4, 0).repeat_interleave(side // 4, 1)
        tensors[f"{index}.image"] = image.contiguous()
        metadata[f"{index}.instruction"] = instruction
    save_file(tensors, folder / "observations.safetensors", metadata=metadata)
    return list(tensors.values())


def tokenizer_of(folder: Path) -> LlamaTokenizerFast:
    return LlamaTokenizerFast(tokenizer_file=str(folder / "tokenizer.json"), pad_token="<PAD>")


def prompt_ids(tokenizer: LlamaTokenizerFast, kind: Kind, instruction: str) -> list[int]:
    """As predict_action: the single space ends the prompt, except before a chain of thought."""
    ids: list[int] = tokenizer(kind.prompt.format(instruction=instruction.lower())).input_ids
    if not kind.reasoning and ids[-1] != llama.SPACE:
        ids = [*ids, llama.SPACE]
    return ids


def target(tokenizer: LlamaTokenizerFast, kind: Kind, index: int) -> list[int]:
    """A well-formed completion: reasoning where there is one, seven action tokens, the end."""
    digits = [1 + (37 * index + 29 * dimension) % 255 for dimension in range(ACTIONS)]
    ids = [llama.SIZE - digit for digit in digits]
    if kind.reasoning:
        text = REASONING.format(10 + index)
        ids = [*tokenizer(text, add_special_tokens=False).input_ids, llama.SPACE, *ids]
    return [*ids, llama.END]


def fit(model: nn.Module, kind: Kind, images: list[Tensor], tokenizer: LlamaTokenizerFast) -> int:
    """Fits the decoder to the observations; the towers keep their random weights."""
    prompts = [prompt_ids(tokenizer, kind, instruction) for instruction in INSTRUCTIONS]
    targets = [target(tokenizer, kind, index) for index in range(len(INSTRUCTIONS))]
    examples = []
    with torch.no_grad():
        for image, prompt, ids in zip(images, prompts, targets, strict=True):
            rows = embed(model, image, prompt, kind.fused)
            patches = rows.shape[1] - len(prompt)
            examples.append((rows[:, 1 : 1 + patches], prompt, ids))
    decoder = model.language_model
    used = torch.tensor(sorted({token for ids in targets for token in ids}))
    with torch.no_grad():
        # Other tokens stay unlikely, so that only these need a gradient.
        decoder.lm_head.weight.mul_(0.1)
    optimiser = torch.optim.Adam(decoder.parameters(), lr=3e-3)
    for step in range(FIT_STEPS_MAX):
        if step % 10 == 0 and fits(decoder, examples):
            return step
        optimiser.zero_grad()
        for patches, prompt, ids in examples:
            scores = hidden_states(decoder, patches, prompt, ids) @ decoder.lm_head.weight[used].T
            wanted = torch.searchsorted(used, torch.tensor(ids))
            nn.functional.cross_entropy(scores, wanted).backward()
        optimiser.step()
    raise SystemExit(f"the decoder did not learn its completions in {FIT_STEPS_MAX} steps")


def hidden_states(decoder: nn.Module, patches: Tensor, prompt: list[int], ids: list[int]) -> Tensor:
    """The states that predict each of `ids`: (ids, hidden)"""
    words = decoder.get_input_embeddings()(torch.tensor([[*prompt, *ids]]))
    rows = torch.cat([words[:, :1], patches, words[:, 1:-1]], dim=1)
    states: Tensor = decoder.model(inputs_embeds=rows).last_hidden_state[0, -len(ids) :]
    return states


@torch.no_grad()
def fits(decoder: nn.Module, examples: list[tuple[Tensor, list[int], list[int]]]) -> bool:
    """Whether every token is the best by a margin that rounding to 16 bits does not change."""
    for patches, prompt, ids in examples:
        scores = decoder.lm_head(hidden_states(decoder, patches, prompt, ids))
        best = scores.topk(2)
        is_right = bool((best.indices[:, 0] == torch.tensor(ids)).all())
        if not is_right or (best.values[:, 0] - best.values[:, 1]).min() < 2.0:
            return False
    return True


def compare(arguments: argparse.Namespace) -> bool:
    """Runs both on the checkpoint's observations; prints a table and whether they agree."""
    folder = arguments.folder
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    kind = kind_of(config, arguments.options)
    with tempfile.TemporaryDirectory() as temporary:
        outputs = Path(temporary) / "outputs.safetensors"
        subprocess.run(
            [arguments.rever.resolve(), "bench", "parity", "--policy", folder,
             "--observations", folder / "observations.safetensors", "--tensors", outputs,
             *arguments.options],
            check=True,
        )  # fmt: skip
        with safe_open(outputs, "pt") as file:
            got = {name: file.get_tensor(name) for name in file.keys()}
            malformed = file.metadata()
    images, instructions = read_observations(folder)
    reference = Reference(arguments, config, kind)
    rows = []
    for index, (image, instruction) in enumerate(zip(images, instructions, strict=True)):
        mine = {
            name: got.get(f"{index}.{name}") for name in ("prompt", "tokens", "logits", "action")
        }
        row = reference.compare(image, instruction, mine)
        row["malformed"] = malformed.get(f"{index}.malformed")
        rows.append(row)
        print(f"{index}: {json.dumps(row)}")
    agrees = all(row["agrees"] for row in rows)
    if arguments.json:
        figures = {"kind": config["llm_backbone_id"], "rows": rows, "agrees": agrees}
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    words = "agree" if agrees else "DIFFER"
    print(f"parity: rever and the reference {words} on {len(rows)} observations")
    return agrees


def kind_of(config: dict[str, Any], options: list[str]) -> Kind:
    if config["llm_backbone_id"] == "llama2-7b-pure":
        return KINDS["openvla"]
    return KINDS["v01" if "off" in options else "ecot"]


def read_observations(folder: Path) -> tuple[list[Tensor], list[str]]:
    with safe_open(folder / "observations.safetensors", "pt") as file:
        metadata = file.metadata()
        count = range(int(metadata["observations"]))
        images = [file.get_tensor(f"{index}.image") for index in count]
    return images, [metadata[f"{index}.instruction"] for index in count]


class Reference:
    """The reference's side of a comparison."""

    def __init__(self, arguments: argparse.Namespace, config: dict[str, Any], kind: Kind) -> None:
        self.folder, self.config, self.kind = arguments.folder, config, kind
        self.tolerance: float = arguments.tolerance
        self.tokenizer = tokenizer_of(self.folder)
        # A full-size decoder is computed one layer at a time, along rever's tokens.
        self.model = None
        if "num_hidden_layers" in config["text_config"]:
            self.model = assemble(config, arguments.reference)
            self.model.load_state_dict(reference_layers.read_all(self.folder))

    @torch.no_grad()
    def compare(self, image: Tensor, instruction: str, mine: dict[str, Tensor]) -> dict[str, Any]:
        """Prompt ids, logits along rever's tokens, greedy tokens, action."""
        prompt = prompt_ids(self.tokenizer, self.kind, instruction)
        tokens = mine["tokens"].tolist()
        ids = [*prompt, *tokens]
        if self.model is None:
            expected = reference_layers.logits(
                self.folder, self.config, image, ids, len(prompt), self.kind.fused
            )
        else:
            expected = logits(self.model, image, ids, len(prompt), self.kind.fused)
        count = len(mine["logits"])
        expected = expected[:count]
        difference = float((expected - mine["logits"]).abs().max())
        spread = float(expected.std())
        # Each token was the reference's best, too: the greedy sequence, teacher-forced.
        best = expected[:, : llama.SIZE].argmax(1).tolist()
        tokens_equal = best[: len(tokens)] == tokens
        row = {
            "prompt_equal": mine["prompt"].tolist() == prompt,
            "tokens": len(tokens),
            "tokens_equal": tokens_equal,
            "logits_difference": difference,
            "logits_deviation": spread,
            "action_difference": self.action_difference(tokens, mine.get("action")),
        }
        within = row["action_difference"] is None or row["action_difference"] < ACTION_TOLERANCE
        close = difference < self.tolerance * spread
        # With 16-bit matrices, rounding may reverse two tokens of nearly equal likelihood.
        tokens_agree = tokens_equal or self.tolerance > TOLERANCE
        row["agrees"] = bool(row["prompt_equal"] and tokens_agree and close and within)
        return row

    def action_difference(self, tokens: list[int], action: Tensor | None) -> float | None:
        """Of rever's tokens, by the reference's un-normalisation and SIMPLER's conversion."""
        if action is None:
            return None
        ids = [token for token in tokens if token >= llama.SIZE - BINS][:ACTIONS]
        if len(ids) < ACTIONS:
            return NO_ACTION
        statistics = next(iter(self.config["norm_stats"].values()))["action"]
        expected = reference_layers.action(ids, statistics, llama.SIZE, BINS)
        return float((torch.tensor(expected) - action.double()).abs().max())


if __name__ == "__main__":
    main()
