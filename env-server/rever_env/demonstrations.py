"""Demonstrations: episodes of the expert with reasoning, one .npz file each."""

import os
import time
from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rever_env import reasoning, workers
from rever_env.expert import Decision
from rever_env.tasks import Task
from rever_env.world import Observation, World

SETTLE_STEPS = 6  # steps recorded after the release of the object on its target
_NOISE_POSITION = 0.005  # metres, stationary standard deviation
_NOISE_YAW = 0.04  # rad
_NOISE_REVERSION = 0.3  # per step
_NOISE_FINE = 0.3  # share of the noise in fine phases
_SLIP_CHANCE = 0.010  # probability per step of reaching that the gripper closes by mistake
_SLIP_STEPS = 3
_PUSH_CHANCE = 0.015  # probability per step that an excursion begins
_PUSH_STEPS = 3
_PUSH_SIZE = 0.015  # metres per step
_REPORT_SECONDS = 2.0


class Noise:
    """Ornstein-Uhlenbeck noise on the action, with rare excursions and false grasps."""

    def __init__(self, seed: int, task: Task) -> None:
        self._generator = np.random.Generator(np.random.PCG64([seed, task.index]))
        self._value = np.zeros(4)  # dx dy dz (m), yaw (rad)
        self._slip_steps = 0
        self._push_steps = 0
        self._push = np.zeros(3)

    def apply(self, decision: Decision) -> NDArray[np.float64]:
        """The noisy action that replaces the expert's."""
        generator = self._generator
        scale = np.array([_NOISE_POSITION] * 3 + [_NOISE_YAW])
        kick = scale * np.sqrt(2.0 * _NOISE_REVERSION) * generator.standard_normal(4)
        self._value += -_NOISE_REVERSION * self._value + kick
        action: NDArray[np.float64] = decision.action.copy()
        share = _NOISE_FINE if decision.fine else 1.0
        action[:3] += share * self._value[:3]
        action[5] += share * self._value[3]
        chances = generator.random(2)
        direction = generator.standard_normal(3)
        if chances[0] < _SLIP_CHANCE and decision.subtask == "reach":
            self._slip_steps = _SLIP_STEPS
        if chances[1] < _PUSH_CHANCE and decision.subtask in ("reach", "move"):
            self._push_steps = _PUSH_STEPS
            direction[2] = abs(direction[2])  # the gripper must not hit the table
            self._push = _PUSH_SIZE * direction / np.linalg.norm(direction)
        if self._slip_steps > 0:
            self._slip_steps -= 1
            action[6] = -1.0 if decision.subtask == "reach" else action[6]
        if self._push_steps > 0:
            self._push_steps -= 1
            action[:3] += self._push
        return action


@dataclass
class Annotator:
    """Composes the reasoning of a step; remembers the last visible box of each object."""

    world: World
    boxes: list[reasoning.Box | None]

    @classmethod
    def begin(cls, world: World) -> "Annotator":
        return cls(world, [None, None])

    def text(self, decision: Decision) -> str:
        world = self.world
        bodies = world.camera.bodies(world.data)
        for index, name in enumerate((world.task.source, world.task.target)):
            box = reasoning.visible_box(bodies, world.model.body(name).id)
            # A hidden object keeps its last visible box; one that was never visible is a point.
            if box is None and self.boxes[index] is None:
                pixel = self._pixel(world.data.body(name).xpos)
                box = (*pixel, *pixel)
            self.boxes[index] = box if box is not None else self.boxes[index]
        source, target = self.boxes
        assert source is not None and target is not None
        tcp = world.data.site(world.task.settings.tcp).xpos
        opening = world.gripper_opening()
        return reasoning.compose(world.task, decision, opening, (source, target), self._pixel(tcp))

    def _pixel(self, point: NDArray[np.float64]) -> tuple[int, int]:
        return reasoning.square_pixel(*self.world.camera.project(self.world.data, point))


def record(world: World, seed: int, noisy: bool) -> dict[str, Any] | None:
    """One episode as arrays; None if the expert failed.

    For T steps: image uint8 (T, height, width, 3), state float32 (T, 8), expert_action float32
    (T, 7) without noise, reasoning str (T,). Also instruction, task, variant, seed and success.
    """
    observation = world.reset(layout=None, seed=seed)
    noise = Noise(seed, world.task)
    annotator = Annotator.begin(world)
    frames: list[Observation] = []
    labels: list[NDArray[np.float32]] = []
    texts: list[str] = []
    released_steps = 0
    transition = None
    for _ in range(world.task.steps_max):
        decision = world.expert_decision()
        frames.append(observation)
        labels.append(decision.action.astype(np.float32))
        texts.append(annotator.text(decision))
        transition = world.step(noise.apply(decision) if noisy else decision.action)
        observation = transition.observation
        released = transition.statistics.released_success
        released_steps = released_steps + 1 if released else 0
        if released_steps > SETTLE_STEPS:
            break
    if transition is None or not transition.statistics.released_success:
        return None
    return {
        "image": np.stack([frame.image for frame in frames]),
        "state": np.stack([frame.state for frame in frames]),
        "expert_action": np.stack(labels),
        "reasoning": np.array(texts),
        "instruction": np.array(world.task.instruction),
        "task": np.array(world.task.name),
        "variant": np.array(world.task.variant),
        "seed": np.array(seed, dtype=np.int64),
        "success": np.array(True),
    }


@dataclass(frozen=True)
class Share:
    """The episodes of one process: every stride-th one from an offset."""

    tasks: tuple[Task, ...]
    episodes: int
    seed: int
    out: Path
    noisy: bool
    offset: int
    stride: int


def folder(out: Path, task: Task) -> Path:
    """The folder of a task's episodes: TASK, or TASK@VARIANT unless it is the default variant."""
    return out / str(task.id).replace("/", "@")


def record_share(share: Share) -> dict[str, tuple[int, int]]:
    """Records the missing episodes; returns the numbers of kept and failed ones per task.

    A failed episode leaves an empty .failed file, so that a resumed run does not repeat it.
    """
    counts = {str(task.id): [0, 0] for task in share.tasks}
    worlds = [World(task) for task in share.tasks]
    try:
        # Tasks alternate, so that an interrupted run has equally many episodes of each.
        for index in range(share.offset, share.episodes, share.stride):
            for world in worlds:
                seed = share.seed + index
                name = str(world.task.id)
                path = folder(share.out, world.task) / f"{seed}.npz"
                failure = path.with_suffix(".failed")
                if path.exists() or failure.exists():
                    counts[name][0 if path.exists() else 1] += 1
                    continue
                episode = record(world, seed, share.noisy)
                counts[name][0 if episode is not None else 1] += 1
                if episode is None:
                    failure.touch()
                    continue
                temporary = path.with_suffix(f".{os.getpid()}.partial")
                with open(temporary, "wb") as file:
                    np.savez_compressed(file, **episode)
                temporary.rename(path)
    finally:
        for world in worlds:
            world.close()
    return {name: (kept, failed) for name, (kept, failed) in counts.items()}


def demonstrate(
    tasks: list[Task],
    episodes: int,
    seed: int,
    out: Path,
    *,
    noisy: bool,
    processes: int,
    report: Callable[[str], None],
) -> dict[str, tuple[int, int]]:
    """Records episodes of every task with the seeds from `seed` on; skips existing files.

    report: receives progress lines. Returns the numbers of kept and failed episodes per task.
    """
    for task in tasks:
        folder(out, task).mkdir(parents=True, exist_ok=True)
    shares = [
        Share(tuple(tasks), episodes, seed, out, noisy, offset, processes)
        for offset in range(processes)
    ]
    started = time.monotonic()
    total = episodes * len(tasks)
    seeds = range(seed, seed + episodes)
    before = _recorded(tasks, seeds, out)
    with workers.pool(processes) as pool:
        futures = [pool.submit(record_share, share) for share in shares]
        while not all(future.done() for future in futures):
            wait(futures, timeout=_REPORT_SECONDS)
            done = _recorded(tasks, seeds, out)
            seconds = time.monotonic() - started
            left = (total - done) * seconds / max(done - before, 1)
            report(f"{done} of {total} episodes, {seconds:.0f} s, about {left:.0f} s remaining")
        results = [future.result() for future in futures]
    return {
        str(task.id): (
            sum(result[str(task.id)][0] for result in results),
            sum(result[str(task.id)][1] for result in results),
        )
        for task in tasks
    }


def _recorded(tasks: list[Task], seeds: range, out: Path) -> int:
    """The number of recorded episodes; the folder may hold other seeds, too."""
    return sum(
        entry.suffix in (".npz", ".failed") and entry.stem.isdecimal() and int(entry.stem) in seeds
        for task in tasks
        for entry in folder(out, task).iterdir()
    )
