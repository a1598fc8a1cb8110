"""Measures a checkpoint on held-out episodes: teacher-forced, and on its own greedy text.

python agent/training/evaluate.py --model DIR --demonstrations DIR [--json FILE]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import checkpoint
import dataset
import demonstration
from actions import DIMENSIONS, Statistics, actions_from_digits, world_from_model
from generation import generate
from network import Network
from tokenizer import COORDINATE_LEVELS, COORDINATE_STEP_PIXELS, FIRST_COORDINATE_ID, Tokenizer

BATCH = 64


@dataclass(frozen=True)
class HeldOut:
    """Mean errors of the most likely token at each position."""

    frames: int
    # Accuracy of the words (without coordinates and actions).
    phrase_accuracy: float
    # Accuracy of the MOVE phrase.
    move_accuracy: float
    # Pixels of the 256-pixel square, mean over coordinates.
    box_error_pixels: float
    gripper_error_pixels: float
    # Mean absolute error over x, y, z.
    translation_error_mm: float
    # Mean absolute error of the rotation about z.
    yaw_error_degrees: float
    gripper_accuracy: float
    # Cross-entropy of words, coordinates and actions against hard targets, nats per token; None if
    # the model reads its own text.
    loss: float | None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--demonstrations", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=1_000_000, help="maximum number of frames")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    policy = checkpoint.read(arguments.model)
    _, held_out = demonstration.split(demonstration.find(arguments.demonstrations))
    frames = dataset.tabulate(dataset.read(held_out), policy.tokenizer, policy.statistics)
    measured = measure_held_out(
        policy.network, policy.tokenizer, policy.statistics, frames, arguments.frames
    )
    own = measure_own_text(
        policy.network, policy.tokenizer, policy.statistics, frames, arguments.frames
    )
    described = {"truth_as_context": asdict(measured), "own_text": asdict(own)}
    text = json.dumps(described, indent=2)
    print(text)
    if arguments.json:
        arguments.json.write_text(text + "\n", encoding="utf-8")


@torch.no_grad()
def measure_held_out(
    network: Network,
    tokenizer: Tokenizer,
    statistics: Statistics,
    frames: dataset.Frames,
    count: int,
) -> HeldOut:
    """Measures at most `count` evenly spaced frames."""
    chosen = spread(frames, count)
    start = network.config.vision.patches + frames.prompt.shape[1] - 1
    answers, losses = [], []
    for indices in np.array_split(chosen, max(1, len(chosen) // BATCH)):
        image, prompt, completion = frames.batch(indices)
        logits = network(image, torch.cat([prompt, completion[:, :-1]], dim=1), start)
        losses.append(torch.nn.functional.cross_entropy(logits.flatten(0, 1), completion.flatten()))
        answers.append(logits.argmax(-1).numpy())
    answer = np.concatenate(answers)
    truth = frames.completion[chosen]
    loss = float(torch.stack(losses).mean())
    return compare(answer, truth, frames.action[chosen], tokenizer, statistics, loss)


@torch.no_grad()
def measure_own_text(
    network: Network,
    tokenizer: Tokenizer,
    statistics: Statistics,
    frames: dataset.Frames,
    count: int,
) -> HeldOut:
    """Greedy completions: each token is the input of the next, as when the policy acts."""
    chosen = spread(frames, count)
    answers = []
    for indices in np.array_split(chosen, max(1, len(chosen) // BATCH)):
        image, prompt, completion = frames.batch(indices)
        length = completion.shape[1]
        answers.append(generate(network, image, prompt, length, 0.0, torch.Generator()).numpy())
    answer = np.concatenate(answers)
    truth = frames.completion[chosen]
    return compare(answer, truth, frames.action[chosen], tokenizer, statistics, None)


def spread(frames: dataset.Frames, count: int) -> NDArray[np.int64]:
    """Indices of at most `count` evenly spaced frames."""
    places = np.linspace(0, len(frames) - 1, min(count, len(frames)))
    return np.unique(places.astype(np.int64))


def compare(
    answer: NDArray[np.int64],
    truth: NDArray[np.int64],
    action: NDArray[np.float32],
    tokenizer: Tokenizer,
    statistics: Statistics,
    loss: float | None,
) -> HeldOut:
    # The kind of token at a position is the same in all completions.
    row = truth[0]
    coordinates = is_coordinate(row)
    places = np.flatnonzero(coordinates)
    boxes, gripper = places[:-2], places[-2:]
    words = np.flatnonzero(~coordinates)[: -DIMENSIONS - 1]
    # " MOVE ..." is two tokens before the gripper's first coordinate: MOVE, GRIPPER POSITION, x, y.
    move = gripper[0] - 2
    actions = slice(-1 - DIMENSIONS, -1)
    # A token that is no action id would be malformed; here it counts as the nearest bin.
    digits = np.clip(tokenizer.size - answer[:, actions], 1, 256)
    decoded = world_from_model(actions_from_digits(digits, statistics))
    error = np.abs(decoded - action)
    return HeldOut(
        frames=len(truth),
        phrase_accuracy=float((answer[:, words] == truth[:, words]).mean()),
        move_accuracy=float((answer[:, move] == truth[:, move]).mean()),
        box_error_pixels=coordinate_error(answer[:, boxes], truth[:, boxes]),
        gripper_error_pixels=coordinate_error(answer[:, gripper], truth[:, gripper]),
        translation_error_mm=float(1000.0 * error[:, :3].mean()),
        yaw_error_degrees=float(np.degrees(error[:, 5].mean())),
        gripper_accuracy=float((decoded[:, 6] == np.sign(action[:, 6])).mean()),
        loss=loss,
    )


def is_coordinate(ids: NDArray[np.int64]) -> NDArray[np.bool_]:
    last = FIRST_COORDINATE_ID + 3 * COORDINATE_LEVELS
    return (ids >= FIRST_COORDINATE_ID) & (ids < last)


def coordinate_error(answer: NDArray[np.int64], truth: NDArray[np.int64]) -> float:
    """Errors in pixels; a token that is no coordinate counts as the width of the square."""
    level = (answer - FIRST_COORDINATE_ID) % COORDINATE_LEVELS
    wanted = (truth - FIRST_COORDINATE_ID) % COORDINATE_LEVELS
    error = np.where(is_coordinate(answer), np.abs(level - wanted), COORDINATE_LEVELS)
    return float(COORDINATE_STEP_PIXELS * error.mean())


if __name__ == "__main__":
    main()
