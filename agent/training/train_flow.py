"""Trains bridge-flow, a flow-matching policy over chunks of actions, from demonstrations.

    python agent/training/train_flow.py --demonstrations DIR --out DIR --steps 3000

The vision tower is bridge-small's and stays as it is; its outputs are computed once and kept in
OUT/training_features.npy and OUT/held_out_features.npy, 25 kB per frame. Rerun the same command to
resume an interrupted run: batches and noise are functions of seed and step, learning rates of step
and --steps. While the outputs are computed they are also in memory, 3 GB for 120,000 frames.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import checkpoint
import dataset
import demonstration
import flow
import optimiser
from actions import Statistics, model_from_world
from demonstration import Demonstration

GRADIENT_NORM_MAX = 1.0
# Noisy chunks per frame and step: they share the prefix, which is most of the work.
DRAWS = 4
REPORT_STEPS = 50
SAVE_STEPS = 250
HELD_OUT_FRAMES = 1024
# What may not change when a run is resumed.
FIXED = ("demonstrations", "model", "seed", "batch", "learning_rate", "adam_learning_rate")


@dataclass(frozen=True)
class Options:
    demonstrations: Path
    out: Path
    model: Path
    steps: int
    seed: int
    batch: int
    learning_rate: float
    adam_learning_rate: float
    threads: int


@dataclass(frozen=True)
class Chunks:
    """F frames with the tower's outputs and the next actions."""

    # (F, patches, vision width) float16
    features: NDArray[np.float16]
    # (F, prompt tokens)
    prompt: NDArray[np.int64]
    # (F, 8), as the world gives them
    state: NDArray[np.float32]
    # (F, chunk, 7), scaled to -1..1
    actions: NDArray[np.float32]
    # (F,) sampling weight, sum 1
    weight: NDArray[np.float64]

    def take(self, indices: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Features, prompts, states and actions of a batch."""
        ordered = np.sort(indices)
        return (
            torch.from_numpy(self.features[ordered].astype(np.float32)),
            torch.from_numpy(self.prompt[ordered]),
            torch.from_numpy(self.state[ordered]),
            torch.from_numpy(self.actions[ordered]),
        )


def main() -> None:
    options = parse(sys.argv[1:])
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    small = checkpoint.read(options.model)
    options.out.mkdir(parents=True, exist_ok=True)
    check_unchanged(options)
    training, held_out = demonstration.split(demonstration.find(options.demonstrations))
    vision = small.network.vision_backbone.featurizer.eval()
    frames = prepare("training", training, small, options.out)
    checks = prepare("held_out", held_out, small, options.out)
    config = flow.FlowConfig(
        vision=small.network.config.vision,
        vocabulary=small.tokenizer.size,
        prompt=frames.prompt.shape[1],
        chunk=frames.actions.shape[1],
    )
    network = flow.FlowNetwork(config)
    states = torch.from_numpy(frames.state)
    policy = flow.FlowPolicy(
        network, vision, small.tokenizer, small.statistics, states.mean(0), states.std(0)
    )
    count = sum(p.numel() for module in (network, vision) for p in module.parameters())
    print(
        f"{len(frames.prompt)} frames; held out {len(checks.prompt)} frames; "
        f"{count / 1e6:.2f} M parameters",
        flush=True,
    )
    train(options, policy, frames, checks)


def check_unchanged(options: Options) -> None:
    """Notes what a run depends on, or compares it with the first start. Raises ValueError."""
    path = options.out / "options.json"
    described = {name: str(getattr(options, name)) for name in FIXED}
    if not path.exists():
        checkpoint.replace(path, json.dumps(described, indent=2) + "\n")
        return
    noted = json.loads(path.read_text(encoding="utf-8"))
    for name, got in described.items():
        if got != noted[name]:
            raise ValueError(
                f"{path}: expected {name} {noted[name]} to resume, got {got}; choose another --out"
            )


def prepare(name: str, paths: list[Path], small: checkpoint.Checkpoint, out: Path) -> Chunks:
    """Reads the demonstrations, or what an earlier start has made of them."""
    features_path, table_path = out / f"{name}_features.npy", out / f"{name}.npz"
    if not table_path.exists():
        compute(paths, small, features_path, table_path)
    with np.load(table_path) as table:
        return Chunks(
            features=np.load(features_path, mmap_mode="r"),
            prompt=table["prompt"],
            state=table["state"],
            actions=table["actions"],
            weight=table["weight"],
        )


@torch.no_grad()
def compute(
    paths: list[Path], small: checkpoint.Checkpoint, features_path: Path, table_path: Path
) -> None:
    tower = small.network.vision_backbone.featurizer.eval()
    tower_config = small.network.config.vision
    light: list[Demonstration] = []
    features: list[NDArray[np.float16]] = []
    prompts: list[list[int]] = []
    actions: list[NDArray[np.float32]] = []
    started = time.monotonic()
    for index, path in enumerate(paths):
        episode = Demonstration.read(path)
        features.append(flow.see(tower, torch.from_numpy(episode.image)).half().numpy())
        prompts += [small.tokenizer.prompt(episode.instruction)] * len(episode.image)
        actions.append(chunks(episode, small.statistics))
        light.append(dataclasses.replace(episode, image=episode.image[:0]))
        if index % 200 == 199:
            rate = (index + 1) / (time.monotonic() - started)
            print(f"features: {index + 1}/{len(paths)} episodes, {rate:.1f}/s", flush=True)
    lengths = {len(prompt) for prompt in prompts}
    if len(lengths) != 1:
        raise ValueError(f"prompt tokens: expected one length, got {sorted(lengths)}")
    frames = len(prompts)
    shape = (frames, tower_config.patches, tower_config.embed_dim)
    table = np.lib.format.open_memmap(features_path, "w+", np.float16, shape)
    np.concatenate(features, out=table)
    table.flush()
    partial = table_path.with_name("partial.npz")
    np.savez(
        partial,
        prompt=np.array(prompts, dtype=np.int64),
        state=np.concatenate([episode.state for episode in light]),
        actions=np.concatenate(actions),
        weight=dataset.weigh(light),
    )
    partial.replace(table_path)


def chunks(episode: Demonstration, statistics: Statistics, length: int = 4) -> NDArray[np.float32]:
    """(frames, length, 7) scaled to -1..1: each frame's label and those of the next frames.

    After the end of the episode: no motion, gripper as in the last frame.
    """
    actions = model_from_world(episode.expert_action.astype(np.float64))
    still = np.zeros(actions.shape[1])
    still[6] = actions[-1, 6]
    padded = np.concatenate([actions, np.tile(still, (length - 1, 1))])
    low, high = np.array(statistics.q01), np.array(statistics.q99)
    scaled = np.clip(2.0 * (padded - low) / (high - low) - 1.0, -1.0, 1.0)
    windows = [scaled[offset : offset + len(actions)] for offset in range(length)]
    return np.stack(windows, axis=1).astype(np.float32)


def train(options: Options, policy: flow.FlowPolicy, frames: Chunks, checks: Chunks) -> None:
    network = policy.network
    optimisers = optimiser.build(network, options.learning_rate, options.adam_learning_rate)
    rates = [group["lr"] for each in optimisers for group in each.param_groups]
    step, seconds = resume(options, network, optimisers)
    recent: list[float] = []
    clock = time.monotonic()
    while step < options.steps:
        factor = optimiser.rate_factor(step, step / options.steps)
        groups = [group for each in optimisers for group in each.param_groups]
        for group, rate in zip(groups, rates, strict=True):
            group["lr"] = rate * factor
        drawn = dataset.draw(frames.weight, options.batch, options.seed, step)
        noise = torch.Generator().manual_seed(options.seed * 1_000_003 + step)
        value = loss(policy, *frames.take(drawn), noise)
        value.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), GRADIENT_NORM_MAX)
        for each in optimisers:
            each.step()
            each.zero_grad(set_to_none=True)
        step += 1
        recent.append(float(value.detach()))
        if not math.isfinite(recent[-1]):
            raise RuntimeError(f"loss at step {step}: expected a number, got {recent[-1]}")
        seconds += time.monotonic() - clock
        clock = time.monotonic()
        if step % REPORT_STEPS == 0:
            print(
                f"step {step:5d}  loss {np.mean(recent):.4f}  "
                f"{step * options.batch / seconds:5.1f} frames/s  {seconds / 60:5.1f} min, "
                f"{seconds / step * (options.steps - step) / 60:5.1f} remaining",
                flush=True,
            )
            recent = []
        if step % SAVE_STEPS == 0 or step == options.steps:
            save(options, network, optimisers, step, seconds)
            flow.write(options.out / "checkpoint", policy)
            measured = {"step": step, "seconds": seconds, **measure(policy, checks)}
            with (options.out / "held_out.jsonl").open("a") as file:
                file.write(json.dumps(measured) + "\n")
            print(f"held out: {json.dumps(measured)}", flush=True)


def loss(
    policy: flow.FlowPolicy,
    features: Tensor,
    prompt: Tensor,
    state: Tensor,
    actions: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Mean squared error of the velocity at random times between noise and actions.

    As in pi0: times lean to the noisy side, t = 0.999 (1 - b) with b from Beta(1.5, 1).
    """
    target = actions.repeat_interleave(DRAWS, 0)
    noise = torch.randn(target.shape, generator=generator)
    # The inverse of the distribution function b^1.5.
    time_ = 0.999 * (1.0 - torch.rand(len(target), generator=generator) ** (1.0 / 1.5))
    noisy = time_[:, None, None] * target + (1.0 - time_[:, None, None]) * noise
    states = policy.scale_state(state).repeat_interleave(DRAWS, 0)
    network = policy.network
    with torch.autocast("cpu", torch.bfloat16):
        velocity = network.velocity(network.condition(features, prompt), states, noisy, time_)
    return (velocity.float() - (target - noise)).square().mean()


@torch.no_grad()
def measure(policy: flow.FlowPolicy, checks: Chunks) -> dict[str, float]:
    """Errors of the first action of one sample on held-out frames, in the actions' units."""
    spread = np.linspace(0, len(checks.prompt) - 1, min(HELD_OUT_FRAMES, len(checks.prompt)))
    features, prompt, state, actions = checks.take(spread.astype(np.int64))
    noise = torch.randn(actions.shape, generator=torch.Generator().manual_seed(0))
    network = policy.network.eval()
    sampled = network.sample(features, prompt, policy.scale_state(state), noise)
    network.train()
    low, high = flow.bounds(policy.statistics)
    error = 0.5 * (sampled - actions)[:, 0].abs() * (high - low)
    return {
        "translation_mm": 1000.0 * float(error[:, :3].mean()),
        "yaw_degrees": math.degrees(float(error[:, 5].mean())),
        "gripper_right": float(((sampled[:, 0, 6] > 0) == (actions[:, 0, 6] > 0)).float().mean()),
    }


def save(
    options: Options,
    network: flow.FlowNetwork,
    optimisers: list[torch.optim.Optimizer],
    step: int,
    seconds: float,
) -> None:
    partial = options.out / "state.pt.partial"
    state = {
        "network": network.state_dict(),
        "optimisers": [each.state_dict() for each in optimisers],
        "step": step,
        "seconds": seconds,
    }
    torch.save(state, partial)
    partial.replace(options.out / "state.pt")


def resume(
    options: Options, network: flow.FlowNetwork, optimisers: list[torch.optim.Optimizer]
) -> tuple[int, float]:
    """Continues from the last saved state; step and seconds."""
    path = options.out / "state.pt"
    if not path.exists():
        return 0, 0.0
    state: dict[str, Any] = torch.load(path, weights_only=True)
    network.load_state_dict(state["network"])
    for each, saved in zip(optimisers, state["optimisers"], strict=True):
        each.load_state_dict(saved)
    print(f"resuming from step {state['step']} of {path}", flush=True)
    return int(state["step"]), float(state["seconds"])


def parse(arguments: list[str]) -> Options:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    add = parser.add_argument
    add("--demonstrations", type=Path, required=True, help="folder with TASK/SEED.npz")
    add("--out", type=Path, required=True, help="write the checkpoint to this folder")
    included = Path(__file__).parent.parent / "models" / "bridge-small"
    add("--model", type=Path, default=included, help="whose vision tower (default: bridge-small)")
    add("--steps", type=int, required=True, help="train for so many steps")
    add("--seed", type=int, default=0, help="seed of weights and batches (default: 0)")
    add("--batch", type=int, default=64, help="frames per step (default: 64)")
    add("--learning-rate", type=float, default=4e-3, help="of Muon (default: 4e-3)")
    add("--adam-learning-rate", type=float, default=2e-3, help="of Adam (default: 2e-3)")
    add("--threads", type=int, default=2, help="CPU threads (default: 2)")
    return Options(**vars(parser.parse_args(arguments)))


if __name__ == "__main__":
    main()
