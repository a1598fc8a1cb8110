"""Initial layouts: SIMPLER's 24 of each task, and random ones at a distance from them."""

import math
from dataclasses import dataclass, replace

from rever_env.fault import InvalidReset
from rever_env.tasks import Layout, Pose, Task

_MASK = (1 << 64) - 1
_DRAWS_MAX = 10_000
SEED_LIMIT = 1 << 53  # seeds must be exact in a double


@dataclass
class SplitMix64:
    """SplitMix64 by Steele, Lea and Flood: one 64-bit word of state, equal in every language."""

    state: int

    def next_word(self) -> int:
        self.state = (self.state + 0x9E3779B97F4A7C15) & _MASK
        word = self.state
        word = ((word ^ (word >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
        word = ((word ^ (word >> 27)) * 0x94D049BB133111EB) & _MASK
        return word ^ (word >> 31)

    def uniform(self, low: float, high: float) -> float:
        """low + (high - low) * u with u in [0, 1) on a grid of 2^-53."""
        return low + (high - low) * ((self.next_word() >> 11) * 2.0**-53)


def place(task: Task, layout: int | None, seed: int) -> Layout:
    """The layout of one reset: a fixed one, or one drawn from the seed."""
    if not 0 <= seed < SEED_LIMIT:
        raise InvalidReset(f"seed {seed}: expected 0 <= seed < 2^53")
    check_layout(task.name, layout, len(task.layouts))
    return _draw(task, seed) if layout is None else task.layouts[layout]


def check_layout(task: str, layout: int | None, count: int) -> None:
    """InvalidReset for a layout beyond the task's count; None is a random layout."""
    if layout is not None and not 0 <= layout < count:
        raise InvalidReset(f"layout {layout}: expected 0 <= layout < {count} for task {task}")


def near_grid_layout(task: Task, layout: Layout) -> bool:
    """Whether source, target and yaw are all within the excluded distance of one layout."""
    ranges = task.random
    radius = ranges.exclusion_radius
    return any(
        _distance(
            layout.source_x - grid.source_x,
            layout.source_y - grid.source_y,
        )
        <= radius
        and _distance(layout.target_x - grid.target_x, layout.target_y - grid.target_y) <= radius
        and _turn(layout.source_yaw - grid.source_yaw) <= ranges.exclusion_yaw
        for grid in task.layouts
    )


def _draw(task: Task, seed: int) -> Layout:
    ranges = task.random
    generator = SplitMix64(_fnv1a(task.name) ^ seed)
    for _ in range(_DRAWS_MAX):
        layout = Layout(
            source_x=generator.uniform(*ranges.source_x),
            source_y=generator.uniform(*ranges.source_y),
            source_yaw=generator.uniform(*ranges.source_yaw),
            target_x=generator.uniform(*ranges.target_x),
            target_y=generator.uniform(*ranges.target_y),
        )
        apart = _distance(layout.source_x - layout.target_x, layout.source_y - layout.target_y)
        if apart >= ranges.separation_min and not near_grid_layout(task, layout):
            # After source and target, so that these are where they are without distractors.
            return replace(layout, distractors=_draw_distractors(task, layout, generator, seed))
    raise InvalidReset(f"task {task.id}, seed {seed}: no free layout in {_DRAWS_MAX} draws")


def _draw_distractors(
    task: Task, layout: Layout, generator: SplitMix64, seed: int
) -> tuple[Pose, ...]:
    placed = [(layout.source_x, layout.source_y), (layout.target_x, layout.target_y)]
    poses = []
    for distractor in task.distractors:
        for _ in range(_DRAWS_MAX):
            pose = Pose(
                generator.uniform(*distractor.x),
                generator.uniform(*distractor.y),
                generator.uniform(*distractor.yaw),
            )
            nearest = min(_distance(pose.x - x, pose.y - y) for x, y in placed)
            if nearest >= distractor.separation_min:
                break
        else:
            raise InvalidReset(
                f"task {task.id}, seed {seed}: no free place for the {distractor.body} in "
                f"{_DRAWS_MAX} draws"
            )
        placed.append((pose.x, pose.y))
        poses.append(pose)
    return tuple(poses)


def _fnv1a(text: str) -> int:
    """64-bit FNV-1a hash: the task's name makes the random streams of tasks different."""
    digest = 0xCBF29CE484222325
    for byte in text.encode():
        digest = ((digest ^ byte) * 0x100000001B3) & _MASK
    return digest


def _distance(x: float, y: float) -> float:
    # Square root of plain products: correctly rounded and equal in every language (hypot is not).
    return math.sqrt(x * x + y * y)


def _turn(degrees: float) -> float:
    """The angle between two headings, 0 to 180 degrees."""
    wrapped = math.fmod(abs(degrees), 360.0)
    return min(wrapped, 360.0 - wrapped)
