"""Measures a checkpoint in simulation: a batch of episodes in lockstep, without a server.

MUJOCO_GL=egl python agent/training/rollout.py --model DIR [--layouts grid|random]
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rever_env import tasks
from rever_env.world import Observation, Statistics, World

import checkpoint
from generation import COMPLETION_TOKENS, decode, generate

# Seeds of the held-out random layouts.
EVALUATION_SEED = 3_000_000_000
GRID = 24


@dataclass(frozen=True)
class Row:
    """The result of one task. Success: at the last step, as in SIMPLER."""

    task: str
    episodes: int
    success: int
    success_any_step: int
    success_released: int
    grasp: int
    malformed_steps: int
    low: float
    high: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument(
        "--tasks", nargs="+", default=[task.name for task in tasks.choose(tasks.load(), None)]
    )
    parser.add_argument("--layouts", choices=["grid", "random"], default="grid")
    parser.add_argument("--episodes", type=int, default=GRID, help="episodes per task")
    parser.add_argument("--temperature", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    policy = checkpoint.read(arguments.model)
    rows = []
    for name in arguments.tasks:
        started = time.monotonic()
        row = measure(
            policy,
            name,
            arguments.episodes,
            arguments.layouts == "grid",
            arguments.temperature,
            arguments.seed,
        )
        rows.append(row)
        print(
            f"{name}: success {row.success}/{row.episodes} [{row.low:.2f}, {row.high:.2f}], "
            f"any step {row.success_any_step}, released {row.success_released}, "
            f"grasp {row.grasp}, malformed steps {row.malformed_steps}, "
            f"{time.monotonic() - started:.0f} s",
            flush=True,
        )
    mean = sum(row.success / row.episodes for row in rows) / len(rows)
    print(f"average over tasks: {mean:.3f}")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")


def measure(
    policy: checkpoint.Checkpoint,
    name: str,
    episodes: int,
    grid: bool,
    temperature: float,
    seed: int,
) -> Row:
    task = tasks.load()[name]
    generator = torch.Generator().manual_seed(seed)
    worlds = [World(task) for _ in range(episodes)]
    observations = [
        world.reset(layout=index % GRID, seed=seed + index)
        if grid
        else world.reset(layout=None, seed=EVALUATION_SEED + seed + index)
        for index, world in enumerate(worlds)
    ]
    prompt = torch.tensor([policy.tokenizer.prompt(task.instruction)]).expand(episodes, -1)
    statistics: list[Statistics] = []
    malformed = 0
    for _ in range(task.steps_max):
        image = torch.from_numpy(np.stack([each.image for each in observations]))
        completion = generate(
            policy.network, image, prompt, COMPLETION_TOKENS, temperature, generator
        ).numpy()
        actions, well_formed = decode(policy, completion)
        malformed += int((~well_formed).sum())
        observations, statistics = advance(worlds, actions)
    for world in worlds:
        world.close()
    success = sum(each.is_success for each in statistics)
    low, high = wilson(success, episodes)
    return Row(
        task=name,
        episodes=episodes,
        success=success,
        success_any_step=sum(each.ever_success for each in statistics),
        success_released=sum(each.released_success for each in statistics),
        grasp=sum(each.ever_grasped for each in statistics),
        malformed_steps=malformed,
        low=low,
        high=high,
    )


def advance(
    worlds: list[World], actions: NDArray[np.float64]
) -> tuple[list[Observation], list[Statistics]]:
    transitions = [world.step(action) for world, action in zip(worlds, actions, strict=True)]
    return [each.observation for each in transitions], [each.statistics for each in transitions]


def wilson(successes: int, count: int) -> tuple[float, float]:
    """The 95 % Wilson interval of a rate."""
    z = 1.959964
    rate = successes / count
    centre = (rate + z * z / (2 * count)) / (1 + z * z / count)
    half = z * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    half /= 1 + z * z / count
    return centre - half, centre + half


if __name__ == "__main__":
    main()
