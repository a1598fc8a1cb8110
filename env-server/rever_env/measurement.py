"""Measures the scripted expert: last-step success per task, clean and with injected noise."""

import math
import time
from collections.abc import Callable
from concurrent.futures import as_completed
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rever_env import workers
from rever_env.demonstrations import Noise
from rever_env.tasks import Task
from rever_env.world import World

if TYPE_CHECKING:
    from rever_env.robosuite_world import RobosuiteWorld

_CHUNK = 10  # episodes per unit of work


@dataclass(frozen=True)
class Chunk:
    """A chunk of episodes of one task and suite, run by one process."""

    task: Task
    suite: str  # "grid", "random" or "random, noise"
    layouts: tuple[int | None, ...]
    seeds: tuple[int, ...]
    in_robosuite: bool = False


@dataclass
class Row:
    """Counts of one task and suite."""

    task: str
    suite: str
    episodes: int = 0
    successes: int = 0  # at the last step of the horizon
    released: int = 0
    grasped: int = 0
    steps_to_release: int = 0  # summed over the episodes with a released success
    ever_released: int = 0
    worst_steps: int = 0
    seconds: float = 0.0
    steps: int = 0
    failed: tuple[int, ...] = ()


def measure(
    tasks: list[Task],
    episodes: int,
    seed: int,
    *,
    processes: int,
    report: Callable[[str], None],
    in_robosuite: bool = False,
) -> list[Row]:
    """All 24 layouts, and random layouts with and without noise."""
    chunks: list[Chunk] = []
    for task in tasks:
        grid = tuple(range(len(task.layouts)))
        chunks.append(Chunk(task, "grid", grid, (0,) * len(grid), in_robosuite))
        for suite in ("random", "random, noise"):
            for start in range(0, episodes, _CHUNK):
                seeds = tuple(range(seed + start, seed + min(start + _CHUNK, episodes)))
                chunks.append(Chunk(task, suite, (None,) * len(seeds), seeds, in_robosuite))
    rows: dict[tuple[str, str], Row] = {}
    for chunk in chunks:
        key = str(chunk.task.id), chunk.suite
        rows.setdefault(key, Row(*key))
    started = time.monotonic()
    total = sum(len(chunk.seeds) for chunk in chunks)
    with workers.pool(processes) as pool:
        for future in as_completed([pool.submit(run, chunk) for chunk in chunks]):
            part = future.result()
            _add(rows[part.task, part.suite], part)
            done = sum(row.episodes for row in rows.values())
            seconds = time.monotonic() - started
            report(
                f"{done} of {total} episodes, "
                f"about {(total - done) * seconds / done:.0f} s remaining"
            )
    return list(rows.values())


def run(chunk: Chunk) -> Row:
    """Runs the episodes of one chunk to their horizon: SIMPLER judges the last step."""
    row = Row(str(chunk.task.id), chunk.suite)
    world = _world(chunk)
    try:
        started = time.perf_counter()
        for layout, seed in zip(chunk.layouts, chunk.seeds, strict=True):
            _episode(world, chunk, layout, seed, row)
        row.seconds = time.perf_counter() - started
    finally:
        world.close()
    return row


def _world(chunk: Chunk) -> "World | RobosuiteWorld":
    if not chunk.in_robosuite:
        # The images are not used: tiny ones keep rendering cheap.
        return World(chunk.task, image_height=8, image_width=8)
    from rever_env.robosuite_tasks import bridge_task
    from rever_env.robosuite_world import RobosuiteWorld

    return RobosuiteWorld(bridge_task(chunk.task), 0, 0)


def table(rows: list[Row]) -> str:
    """The rows as a text table with 95 % Wilson intervals."""
    head = ("task", "suite", "success", "95 % interval", "released", "grasped", "release step")
    lines = [head]
    for row in rows:
        low, high = wilson(row.successes, row.episodes)
        mean = row.steps_to_release / max(row.ever_released, 1)
        lines.append(
            (
                row.task,
                row.suite,
                f"{row.successes}/{row.episodes}",
                f"{low:.3f}-{high:.3f}",
                f"{row.released}",
                f"{row.grasped}",
                f"mean {mean:.1f}, worst {row.worst_steps}",
            )
        )
        if row.failed:
            lines.append((f"  failed: {', '.join(map(str, row.failed))}",) + ("",) * 6)
    widths = [max(len(line[column]) for line in lines if line[1]) for column in range(len(head))]
    text = [
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    ]
    milliseconds = 1e3 * sum(row.seconds for row in rows) / max(sum(row.steps for row in rows), 1)
    return "\n".join([*text, f"{milliseconds:.2f} ms per control step with the expert"])


def wilson(successes: int, episodes: int) -> tuple[float, float]:
    """The 95 % Wilson score interval of a rate."""
    if episodes == 0:
        return 0.0, 1.0
    z = 1.959963984540054
    share = successes / episodes
    centre = share + z * z / (2 * episodes)
    spread = z * math.sqrt(share * (1 - share) / episodes + z * z / (4 * episodes**2))
    scale = 1 + z * z / episodes
    return max((centre - spread) / scale, 0.0), min((centre + spread) / scale, 1.0)


def _episode(
    world: "World | RobosuiteWorld", chunk: Chunk, layout: int | None, seed: int, row: Row
) -> None:
    world.reset(layout=layout, seed=seed)
    steps = 0
    noise = Noise(seed, chunk.task) if chunk.suite == "random, noise" else None
    released_at = None
    while True:
        decision = world.expert_decision()
        transition = world.step(noise.apply(decision) if noise else decision.action)
        steps += 1
        if transition.statistics.released_success and released_at is None:
            released_at = steps
        if transition.truncated:
            break
    row.episodes += 1
    row.steps += steps
    row.successes += transition.statistics.is_success
    row.released += transition.statistics.released_success
    row.grasped += transition.statistics.ever_grasped
    if released_at is not None:
        row.ever_released += 1
        row.steps_to_release += released_at
        row.worst_steps = max(row.worst_steps, released_at)
    if not transition.statistics.is_success:
        row.failed += (layout if layout is not None else seed,)


def _add(row: Row, part: Row) -> None:
    for name in ("episodes", "successes", "released", "grasped", "steps_to_release"):
        setattr(row, name, getattr(row, name) + getattr(part, name))
    row.ever_released += part.ever_released
    row.worst_steps = max(row.worst_steps, part.worst_steps)
    row.seconds += part.seconds
    row.steps += part.steps
    row.failed += part.failed
