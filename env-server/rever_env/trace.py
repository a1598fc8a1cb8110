"""The trace subcommand: all numbers of episodes, for the comparison of two simulators."""

import hashlib
import json
import struct
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rever_env.tasks import Task
from rever_env.world import Observation, Statistics, World


def lines(
    task: Task, starts: list[tuple[int | None, int]], actions: Path | None, side: int
) -> Iterator[str]:
    """One JSON object for each reset and each step, up to the horizon or the end of the actions.

    starts: layout and seed of each episode; all episodes run in the same environment. actions: a
    file with 7 numbers per line; None for the scripted expert. Floats are written as their bits,
    16 (or 8) hexadecimal digits.
    """
    with World(task, side, side) as world:
        for layout, seed in starts:
            name = f"{task.id}, layout {'random' if layout is None else layout}, seed {seed}"
            observation = world.reset(layout=layout, seed=seed)
            yield _line(name, world, observation, None)
            for action in read(actions) if actions else _expert(world):
                transition = world.step(action)
                yield _line(name, world, transition.observation, transition.statistics)
                if transition.truncated:
                    break


def read(file: Path) -> Iterator[NDArray[np.float64]]:
    """The actions in a file, float64 (7,), rounded to 32 bits as in the protocol."""
    for line in file.read_text(encoding="utf-8").splitlines():
        yield np.array([float(word) for word in line.split()], np.float32).astype(np.float64)


def _expert(world: World) -> Iterator[NDArray[np.float64]]:
    while True:
        yield world.expert_action().astype(np.float32).astype(np.float64)


def _line(
    episode: str, world: World, observation: Observation, statistics: Statistics | None
) -> str:
    return json.dumps(
        {
            "episode": episode,
            "step": world.steps,
            "qpos": _bits(world.data.qpos),
            "qvel": _bits(world.data.qvel),
            "state": _bits(observation.state),
            "expert_action": _bits(world.expert_action().astype(np.float32)),
            "image": hashlib.sha256(observation.image.tobytes()).hexdigest(),
            "statistics": asdict(statistics) if statistics else None,
        }
    )


def _bits(numbers: NDArray[np.float64] | NDArray[np.float32]) -> list[str]:
    kind = ">f" if numbers.dtype == np.float32 else ">d"
    return [struct.pack(kind, number).hex() for number in numbers.tolist()]
