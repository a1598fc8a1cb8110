"""One demonstration file: an episode of the noisy expert with clean labels and reasoning."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Demonstration:
    """T observations of one episode with the expert's reasoning and action for each."""

    task: str
    instruction: str
    seed: int
    # (T, 128, 128, 3)
    image: NDArray[np.uint8]
    # (T, 8): x y z (m), roll pitch yaw (rad), 0, gripper opening 0..1
    state: NDArray[np.float32]
    # (T, 7), the noise-free label in the environment's convention
    expert_action: NDArray[np.float32]
    # T texts, from " TASK:" to " ACTION:"
    reasoning: list[str]

    @classmethod
    def read(cls, path: Path) -> Demonstration:
        with np.load(path) as arrays:
            return cls(
                task=str(arrays["task"]),
                instruction=str(arrays["instruction"]),
                seed=int(arrays["seed"]),
                image=arrays["image"],
                state=arrays["state"],
                expert_action=arrays["expert_action"],
                # The text in the file ends before the action; the model's completion starts with a
                # space and includes the action.
                reasoning=[f" {text} ACTION:" for text in arrays["reasoning"]],
            )


def find(directory: Path) -> dict[str, list[Path]]:
    """The files of each task in order of their seeds."""
    folders = sorted(item for item in directory.iterdir() if item.is_dir())
    files = {
        folder.name: sorted(folder.glob("*.npz"), key=lambda item: int(item.stem))
        for folder in folders
    }
    if not files or not all(files.values()):
        raise FileNotFoundError(f"demonstrations: expected TASK/SEED.npz below {directory}")
    return files


def split(
    files: dict[str, list[Path]], held_out_share: float = 0.05
) -> tuple[list[Path], list[Path]]:
    """Training files and held-out files; the last seeds of each task are held out."""
    training: list[Path] = []
    held_out: list[Path] = []
    for paths in files.values():
        count = max(1, round(held_out_share * len(paths)))
        training += paths[:-count]
        held_out += paths[-count:]
    return training, held_out
