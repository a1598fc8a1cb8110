"""Demonstrations as one table of frames (image, prompt, completion), and sampling of frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from actions import DIMENSIONS, Statistics, digits_from_actions, model_from_world
from demonstration import Demonstration
from tokenizer import ACTION_BINS, COORDINATE_LEVELS, END, FIRST_COORDINATE_ID, Tokenizer

# Oversampling of the first frames of a subtask: they look almost like the last ones of the previous
# subtask, and a greedy policy would otherwise repeat that one forever.
TRANSITION_WEIGHT = 2.0
# Roll, pitch and gripper have few values; their targets are hard.
EXACT_DIMENSIONS = (3, 4, 6)


@dataclass(frozen=True)
class Frames:
    """F frames. All prompts have one length, and all completions; checked when they are read."""

    # (F, 128, 128, 3)
    image: NDArray[np.uint8]
    # (F, prompt tokens), `<s>` first
    prompt: NDArray[np.int64]
    # (F, completion tokens): reasoning, 7 action tokens, `</s>`
    completion: NDArray[np.int64]
    # (F, 7) in the environment's convention
    action: NDArray[np.float32]
    task: list[str]
    # (F,) sampling weight
    weight: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.image)

    def draw(self, count: int, seed: int, step: int) -> NDArray[np.int64]:
        """Indices of a batch."""
        return draw(self.weight, count, seed, step)

    def batch(self, indices: NDArray[np.int64]) -> tuple[Tensor, Tensor, Tensor]:
        """(batch, 128, 128, 3), (batch, prompt), (batch, completion)."""
        ordered = np.sort(indices)
        return (
            torch.from_numpy(self.image[ordered]),
            torch.from_numpy(self.prompt[ordered]),
            torch.from_numpy(self.completion[ordered]),
        )


def read(paths: Sequence[Path]) -> list[Demonstration]:
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(Demonstration.read, paths))


def measure(demonstrations: Sequence[Demonstration]) -> Statistics:
    actions = np.concatenate([episode.expert_action for episode in demonstrations])
    return Statistics.measure(model_from_world(actions.astype(np.float64)))


def tabulate(
    demonstrations: Sequence[Demonstration], tokenizer: Tokenizer, statistics: Statistics
) -> Frames:
    actions = np.concatenate([episode.expert_action for episode in demonstrations])
    digits = digits_from_actions(model_from_world(actions.astype(np.float64)), statistics)
    reasoning = [tokenizer.encode(t) for episode in demonstrations for t in episode.reasoning]
    lengths = {len(ids) for ids in reasoning}
    if len(lengths) != 1:
        raise ValueError(f"reasoning tokens: expected one length, got {sorted(lengths)}")
    ends = np.full((len(actions), 1), END)
    tasks = [episode.task for episode in demonstrations for _ in episode.reasoning]
    return Frames(
        image=np.concatenate([episode.image for episode in demonstrations]),
        prompt=np.array(
            [tokenizer.prompt(e.instruction) for e in demonstrations for _ in e.reasoning]
        ),
        completion=np.concatenate([np.array(reasoning), tokenizer.size - digits, ends], axis=1),
        action=actions,
        task=tasks,
        weight=weigh(demonstrations),
    )


def weigh(demonstrations: Sequence[Demonstration]) -> NDArray[np.float64]:
    """Sampling weights, sum 1: equal for all tasks, larger for the first frames of subtasks."""
    names = np.array([episode.task for episode in demonstrations for _ in episode.reasoning])
    subtasks = [[subtask(text) for text in episode.reasoning] for episode in demonstrations]
    changes = [now != before for row in subtasks for before, now in pairs(row)]
    weight = np.where(changes, TRANSITION_WEIGHT, 1.0)
    for name in set(names):
        weight[names == name] /= weight[names == name].sum()
    shares: NDArray[np.float64] = weight / weight.sum()
    return shares


def draw(weight: NDArray[np.float64], count: int, seed: int, step: int) -> NDArray[np.int64]:
    """Indices of a batch: a function of seed and step only, so that runs can be resumed."""
    generator = np.random.default_rng([seed, step])
    drawn = np.searchsorted(np.cumsum(weight), generator.random(count)).astype(np.int64)
    # Rounding may leave the last sum a little below 1.
    return np.minimum(drawn, len(weight) - 1)


def subtask(text: str) -> str:
    return text.split(" SUBTASK: ")[1].split(" MOVE REASONING:")[0]


def pairs(row: list[str]) -> Iterator[tuple[str, str]]:
    """Each entry paired with the previous one; the first with itself."""
    return zip([row[0], *row[:-1]], row, strict=True)


def soft_targets(
    tokenizer: Tokenizer, rows: int, coordinate_bins: float, action_bins: float
) -> Tensor:
    """Target distributions (tokens, rows) for each correct token.

    Coordinates and action bins have Gaussians over their neighbours with the given standard
    deviations in bins, because a near miss is nearly right. All other targets are hard.
    """
    table = torch.eye(tokenizer.size, rows)
    for first, count, deviation in scales(tokenizer, coordinate_bins, action_bins):
        place = torch.arange(count, dtype=torch.float32)
        distance = (place[:, None] - place[None, :]) / deviation
        share = torch.exp(-0.5 * distance.square())
        share = torch.where(share < 1e-4, 0.0, share)
        table[first : first + count, first : first + count] = share / share.sum(1, keepdim=True)
    return table


def scales(
    tokenizer: Tokenizer, coordinate_bins: float, action_bins: float
) -> list[tuple[int, int, float]]:
    """First id, number of ids and deviation in bins of each range of ids that form a scale."""
    coordinates = [
        (FIRST_COORDINATE_ID + form * COORDINATE_LEVELS, COORDINATE_LEVELS, coordinate_bins)
        for form in range(3)
    ]
    return [*coordinates, (tokenizer.size - ACTION_BINS, ACTION_BINS, action_bins)]


def exact_places(completion_tokens: int) -> NDArray[np.int64]:
    """Positions of the action tokens with hard targets."""
    first = completion_tokens - 1 - DIMENSIONS
    return np.array([first + dimension for dimension in EXACT_DIMENSIONS])


def blur(
    completion: NDArray[np.int64],
    runs: list[tuple[int, int, float]],
    generator: np.random.Generator,
) -> NDArray[np.int64]:
    """Completions with noise like that of the model's own samples, against exposure bias.

    A model trained only on exact values would see its own slightly wrong values for the first time
    when it acts, and trust them more than the image.
    """
    result = completion.copy()
    for first, count, deviation in runs:
        noise = np.rint(generator.normal(0.0, deviation, completion.shape)).astype(np.int64)
        inside = (completion >= first) & (completion < first + count)
        inside[:, exact_places(completion.shape[1])] = False
        moved = np.clip(completion + noise, first, first + count - 1)
        result = np.where(inside, moved, result)
    return result


def position_weights(completion_tokens: int, action_weight: float) -> Tensor:
    """Loss weights (completion tokens,), mean 1: coordinates and actions weigh more than words."""
    weight = torch.ones(completion_tokens)
    weight[-1 - DIMENSIONS : -1] = action_weight
    weight[exact_places(completion_tokens)] = 1.0
    return weight / weight.mean()
