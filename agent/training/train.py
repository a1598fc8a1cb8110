"""Trains the generator from demonstrations and writes an OpenVLA-layout checkpoint.

    python agent/training/train.py --demonstrations DIR --out DIR --minutes 55
    python agent/training/train.py --demonstrations DIR --out DIR --steps 2000

Rerun the same command to resume an interrupted run. With `--steps`, the same seed gives the same
batches and learning rates; with `--minutes`, the learning rate depends on the clock.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rever_env import reasoning, tasks
from torch import Tensor

import checkpoint
import dataset
import demonstration
import optimiser
from actions import Statistics
from evaluate import measure_held_out
from network import DecoderConfig, Network, NetworkConfig, TowerConfig
from tokenizer import Tokenizer

GRADIENT_NORM_MAX = 1.0

# Image, prompt, completion as context, completion as target.
Loss = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Options:
    demonstrations: Path
    out: Path
    minutes: float | None
    steps: int | None
    seed: int
    batch: int
    learning_rate: float
    adam_learning_rate: float
    action_weight: float
    coordinate_bins: float
    action_bins: float
    threads: int
    begin_with: Path | None
    checkpoint_seconds: float
    evaluate_seconds: float
    precision: str
    compiled: bool


@dataclass
class Progress:
    """The progress in a checkpoint, besides weights and optimizer states."""

    step: int = 0
    seconds: float = 0.0


def main() -> None:
    options = parse(sys.argv[1:])
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    training, held_out = demonstration.split(demonstration.find(options.demonstrations))
    episodes = dataset.read(training)
    every_task = tasks.choose(tasks.load(), None)
    tokenizer = Tokenizer.build(
        reasoning.phrases(every_task),
        [task.instruction.lower() for task in every_task],
    )
    statistics = dataset.measure(episodes)
    frames = dataset.tabulate(episodes, tokenizer, statistics)
    del episodes
    checks = dataset.tabulate(dataset.read(held_out), tokenizer, statistics)
    network = Network(network_config(tokenizer))
    count = sum(parameter.numel() for parameter in network.parameters())
    print(
        f"{len(training)} episodes, {len(frames)} frames; held out {len(held_out)} episodes, "
        f"{len(checks)} frames; {tokenizer.size} tokens, completion of "
        f"{frames.completion.shape[1]}; {count / 1e6:.2f} M parameters",
        flush=True,
    )
    Trainer(options, network, tokenizer, statistics, frames, checks).run()


def network_config(tokenizer: Tokenizer) -> NetworkConfig:
    """6 used vision blocks of width 192 on 64 patches, 4 decoder layers of width 256."""
    return NetworkConfig(
        vision=TowerConfig(image_size=128, patch_size=16, embed_dim=192, depth=7, num_heads=3),
        text=DecoderConfig(
            hidden_size=256,
            intermediate_size=640,
            num_hidden_layers=4,
            num_attention_heads=4,
            num_key_value_heads=4,
            vocab_size=tokenizer.size + checkpoint.VOCABULARY_PADDING,
        ),
    )


class Trainer:
    """The loop, its clock and its files."""

    def __init__(
        self,
        options: Options,
        network: Network,
        tokenizer: Tokenizer,
        statistics: Statistics,
        frames: dataset.Frames,
        checks: dataset.Frames,
    ) -> None:
        self.options = options
        self.network = network
        self.tokenizer = tokenizer
        self.statistics = statistics
        self.frames = frames
        self.checks = checks
        self.progress = Progress()
        self.optimisers = optimiser.build(
            network, options.learning_rate, options.adam_learning_rate
        )
        self.rates = [group["lr"] for o in self.optimisers for group in o.param_groups]
        self.loss = loss_function(options, network, tokenizer, frames)
        self.scales = dataset.scales(tokenizer, options.coordinate_bins, options.action_bins)

    def run(self) -> None:
        options = self.options
        options.out.mkdir(parents=True, exist_ok=True)
        described = {key: str(value) for key, value in asdict(options).items()}
        (options.out / "options.json").write_text(json.dumps(described, indent=2) + "\n")
        self.resume()
        clock = last_saved = last_evaluated = time.monotonic()
        recent: list[float] = []
        while (share := self.share()) < 1.0:
            recent.append(self.step(share))
            now = time.monotonic()
            self.progress.seconds += now - clock
            clock = now
            if len(recent) == 20:
                self.report(recent)
                recent = []
            if now - last_saved > options.checkpoint_seconds:
                self.save()
                last_saved = now
            if now - last_evaluated > options.evaluate_seconds:
                self.export()
                last_evaluated = now
        self.save()
        self.export()

    def share(self) -> float:
        """The spent fraction of the budget, 0 to 1."""
        if self.options.steps is not None:
            return self.progress.step / self.options.steps
        assert self.options.minutes is not None
        return self.progress.seconds / (60.0 * self.options.minutes)

    def step(self, share: float) -> float:
        factor = optimiser.rate_factor(self.progress.step, share)
        groups = [group for each in self.optimisers for group in each.param_groups]
        for group, rate in zip(groups, self.rates, strict=True):
            group["lr"] = rate * factor
        options = self.options
        image, prompt, completion = self.frames.batch(
            self.frames.draw(options.batch, options.seed, self.progress.step)
        )
        generator = np.random.default_rng([options.seed, self.progress.step, 1])
        context = torch.from_numpy(dataset.blur(completion.numpy(), self.scales, generator))
        loss = self.loss(image, prompt, context, completion)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), GRADIENT_NORM_MAX)
        for each in self.optimisers:
            each.step()
            each.zero_grad(set_to_none=True)
        self.progress.step += 1
        value = float(loss.detach())
        if not math.isfinite(value):
            raise RuntimeError(f"loss at step {self.progress.step}: expected a number, got {value}")
        return value

    def report(self, recent: list[float]) -> None:
        step, seconds = self.progress.step, self.progress.seconds
        share = max(self.share(), 1e-9)
        left = seconds / share - seconds
        print(
            f"step {step:5d}  loss {sum(recent) / len(recent):.4f}  "
            f"{step * self.options.batch / seconds:5.1f} samples/s  "
            f"{seconds / 60:5.1f} min, {left / 60:5.1f} remaining",
            flush=True,
        )

    def save(self) -> None:
        partial = self.options.out / "state.pt.partial"
        state = {
            "network": self.network.state_dict(),
            "optimisers": [each.state_dict() for each in self.optimisers],
            "progress": asdict(self.progress),
        }
        torch.save(state, partial)
        partial.replace(self.options.out / "state.pt")

    def resume(self) -> None:
        path = self.options.out / "state.pt"
        started = path.exists()
        if not started and self.options.begin_with is None:
            return
        path = path if started else Path(str(self.options.begin_with))
        state: dict[str, Any] = torch.load(path, weights_only=True)
        self.network.load_state_dict(state["network"])
        for each, saved in zip(self.optimisers, state["optimisers"], strict=True):
            each.load_state_dict(saved)
        if started:
            self.progress = Progress(**state["progress"])
        print(f"resuming from step {self.progress.step} of {path}", flush=True)

    def export(self) -> None:
        """Writes the checkpoint in bf16 and measures it on held-out frames."""
        directory = self.options.out / "checkpoint"
        checkpoint.write(directory, self.network, self.tokenizer, self.statistics, torch.bfloat16)
        self.network.eval()
        measured = measure_held_out(self.network, self.tokenizer, self.statistics, self.checks, 512)
        self.network.train()
        line = {**asdict(self.progress), "batch": self.options.batch, **asdict(measured)}
        with (self.options.out / "held_out.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")
        print(f"held out: {json.dumps(asdict(measured))}", flush=True)


def loss_function(
    options: Options, network: Network, tokenizer: Tokenizer, frames: dataset.Frames
) -> Loss:
    """KL divergence from the soft targets over completion tokens, in nats; 0 is perfect."""
    rows = network.config.text.vocab_size
    soft = dataset.soft_targets(tokenizer, rows, options.coordinate_bins, options.action_bins)
    # The second half of the table is for positions with hard targets.
    table = torch.cat([soft, torch.eye(tokenizer.size, rows)])
    half = torch.zeros(frames.completion.shape[1], dtype=torch.int64)
    half[dataset.exact_places(len(half))] = tokenizer.size
    floor = torch.special.entr(table).sum(1)
    weights = dataset.position_weights(frames.completion.shape[1], options.action_weight)
    start = network.config.vision.patches + frames.prompt.shape[1] - 1

    def loss(image: Tensor, prompt: Tensor, context: Tensor, completion: Tensor) -> Tensor:
        tokens = torch.cat([prompt, context[:, :-1]], dim=1)
        with torch.autocast("cpu", torch.bfloat16, enabled=options.precision == "bf16"):
            logits = network(image, tokens, start)
        logits = logits.float()
        answer = completion + half
        targets = table[answer]
        # (batch, completion tokens)
        crossed = torch.logsumexp(logits, -1) - (targets * logits).sum(-1) - floor[answer]
        mean: Tensor = (crossed * weights).mean()
        return mean

    if not options.compiled:
        return loss
    compiled: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor] = torch.compile(
        loss, dynamic=False
    )
    return compiled


def parse(arguments: list[str]) -> Options:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    add = parser.add_argument
    add("--demonstrations", type=Path, required=True, help="folder with TASK/SEED.npz")
    add("--out", type=Path, required=True, help="write the checkpoint to this folder")
    budget = parser.add_mutually_exclusive_group(required=True)
    budget.add_argument("--minutes", type=float, help="train for so many minutes")
    budget.add_argument("--steps", type=int, help="train for so many steps, reproducibly")
    add("--seed", type=int, default=0, help="seed of weights and batches (default: 0)")
    add("--batch", type=int, default=64, help="frames per step (default: 64)")
    add("--learning-rate", type=float, default=4e-3, help="of Muon (default: 4e-3)")
    add("--adam-learning-rate", type=float, default=2e-3, help="of Adam (default: 2e-3)")
    add("--action-weight", type=float, default=2.0, help="loss weight of actions (default: 2)")
    softness = "standard deviation of the soft targets of {}, in bins (default: {})"
    add("--coordinate-bins", type=float, default=1.0, help=softness.format("coordinates", 1))
    add("--action-bins", type=float, default=2.0, help=softness.format("actions", 2))
    add("--threads", type=int, default=2, help="CPU threads (default: 2)")
    add("--begin-with", type=Path, help="start from this state.pt of another run")
    add(
        "--checkpoint-seconds",
        type=float,
        default=120.0,
        help="interval of saving the state (default: 120)",
    )
    add(
        "--evaluate-seconds",
        type=float,
        default=300.0,
        help="interval of measuring on held-out frames (default: 300)",
    )
    add(
        "--precision",
        choices=("bf16", "f32"),
        default="bf16",
        help="of matrix products; weights are f32 (default: bf16)",
    )
    add("--eager", dest="compiled", action="store_false", help="do not compile the network")
    return Options(**vars(parser.parse_args(arguments)))


if __name__ == "__main__":
    main()
