"""Layouts: the 24 layouts of the published table, and random ones clear of them."""

import itertools

import pytest

from rever_env.fault import InvalidReset
from rever_env.layout import SEED_LIMIT, SplitMix64, near_grid_layout, place
from rever_env.tasks import Layout, Task


def _table(name: str) -> list[tuple[float, float, float, float, float]]:
    """SIMPLER's rules, written out anew (ManiSkill2_real2sim put_on_in_scene.py)."""
    if name == "widowx_put_eggplant_in_basket":
        return [
            (x, y, yaw, -0.125, 0.025)
            for x in (-0.115, -0.095)
            for y in (0.191, 0.201, 0.211, 0.221)
            for yaw in (0.0, 45.0, -45.0)
        ]
    yaws, halves = {
        "widowx_spoon_on_towel": ((0.0, 90.0), (0.075,)),
        "widowx_carrot_on_plate": ((180.0, -90.0), (0.075,)),
        "widowx_stack_cube": ((0.0,), (0.05, 0.10)),
    }[name]
    rows = []
    for half in halves:
        points = list(itertools.product((-0.16 - half, -0.16 + half), (-half, half)))
        for source, target in itertools.permutations(points, 2):
            rows += [(*source, yaw, *target) for yaw in yaws]
    return rows


def test_the_24_layouts_equal_the_published_table(task: Task) -> None:
    assert len(task.layouts) == 24
    for layout, expected in enumerate(_table(task.name)):
        got = place(task, layout, seed=0)
        values = (got.source_x, got.source_y, got.source_yaw, got.target_x, got.target_y)
        assert values == pytest.approx(expected, abs=1e-9), layout


def test_random_placements_stay_in_range_and_clear_of_the_grid(task: Task) -> None:
    ranges = task.random
    for seed in range(3000):
        drawn = place(task, None, seed)
        assert not near_grid_layout(task, drawn)
        assert ranges.source_x[0] <= drawn.source_x <= ranges.source_x[1]
        assert ranges.source_y[0] <= drawn.source_y <= ranges.source_y[1]
        assert ranges.source_yaw[0] <= drawn.source_yaw <= ranges.source_yaw[1]
        assert ranges.target_x[0] <= drawn.target_x <= ranges.target_x[1]


def test_the_neighbourhood_of_every_layout_is_excluded(task: Task) -> None:
    radius, yaw = task.random.exclusion_radius, task.random.exclusion_yaw
    for grid in task.layouts:
        inside = Layout(
            grid.source_x + 0.9 * radius,
            grid.source_y,
            grid.source_yaw + 360.0 - 0.9 * yaw,
            grid.target_x,
            grid.target_y - 0.9 * radius,
        )
        assert near_grid_layout(task, inside)


def test_the_generator_gives_the_published_numbers() -> None:
    # First outputs of the public-domain splitmix64.c (Vigna) for these seeds.
    assert SplitMix64(0).next_word() == 0xE220A8397B1DCDAF
    generator = SplitMix64(1234567)
    assert [generator.next_word() for _ in range(3)] == [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
    ]


def test_tasks_do_not_share_draws() -> None:
    from conftest import TASKS

    draws = {task.name: place(task, None, 7).source_y for task in TASKS.values()}
    assert len(set(draws.values())) == len(draws)


@pytest.mark.parametrize(("layout", "seed"), [(24, 0), (-1, 0), (None, -1), (0, SEED_LIMIT)])
def test_out_of_range_placements_are_refused(task: Task, layout: int | None, seed: int) -> None:
    with pytest.raises(InvalidReset, match="expected"):
        place(task, layout, seed)
