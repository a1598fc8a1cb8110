"""The expert: succeeds on a few layouts of each task, clean and disturbed, and says why."""

import re
from pathlib import Path

import numpy as np
import pytest

from rever_env import demonstrations, measurement, reasoning, tasks
from rever_env.measurement import Chunk
from rever_env.tasks import Task
from rever_env.world import World


@pytest.mark.parametrize(
    ("suite", "layouts", "seeds"),
    [
        ("grid", (1, 22), (0, 0)),
        ("random", (None, None), (5, 6)),
        ("random, noise", (None, None), (7, 8)),
    ],
)
def test_the_expert_succeeds(
    task: Task, suite: str, layouts: tuple[int | None, ...], seeds: tuple[int, ...]
) -> None:
    row = measurement.run(Chunk(task, suite, layouts, seeds))
    assert (row.episodes, row.successes, row.released, row.grasped) == (2, 2, 2, 2), row


def test_asking_the_expert_changes_nothing(world: World) -> None:
    world.reset(layout=0, seed=0)
    before = world.save()
    first = world.expert_action()
    assert np.array_equal(first, world.expert_action())
    assert world.save() == before


def test_moves_are_moderate_and_keep_the_gripper_upright(world: World) -> None:
    world.reset(layout=5, seed=0)
    for _ in range(40):
        action = world.expert_action()
        assert np.linalg.norm(action[:3]) <= 0.035 + 1e-9
        assert action[3] == action[4] == 0.0 and abs(action[5]) <= 0.25
        assert action[6] in (-1.0, 1.0)
        world.step(action)


def test_wilson_equals_the_textbook_value() -> None:
    # statsmodels.stats.proportion.proportion_confint(20, 24, method="wilson")
    assert measurement.wilson(20, 24) == pytest.approx((0.64147, 0.93318), abs=1e-4)


def _segments(text: str, vocabulary: list[str]) -> int:
    """Tokens of a text: greedy longest phrases, and one token per coordinate."""
    by_length = sorted(vocabulary, key=len, reverse=True)
    coordinate = re.compile(r"( \[|, )\d+\]?")
    count, position = 0, 0
    while position < len(text):
        phrase = next((p for p in by_length if text.startswith(p, position)), None)
        if phrase is None:
            match = coordinate.match(text, position)
            assert match, f"no token at {text[position : position + 40]!r}"
            phrase = match.group()
        count, position = count + 1, position + len(phrase)
    return count


def test_a_recorded_episode_is_complete_and_tokenises(world: World, task: Task) -> None:
    from conftest import TASKS

    vocabulary = reasoning.phrases(TASKS.values())
    assert len(vocabulary) <= 110
    episode = demonstrations.record(world, 21, True)
    assert episode is not None
    length = len(episode["image"])
    assert episode["image"].shape == (length, 128, 128, 3) and episode["image"].dtype == np.uint8
    assert episode["state"].shape == (length, 8) and episode["state"].dtype == np.float32
    assert episode["expert_action"].shape == (length, 7)
    texts = [str(text) for text in episode["reasoning"]]
    assert len(texts) == length
    for text in texts:
        assert text.startswith(f"TASK: {task.instruction} PLAN: ")
        assert _segments(f" {text} ACTION:", vocabulary) == 17
        numbers = [int(number) for number in re.findall(r"\d+", text)]
        assert len(numbers) == 10
        assert all(0 <= number <= 254 and number % 2 == 0 for number in numbers)
    subtasks = [re.search(r"SUBTASK: (\w+)", text).group(1) for text in texts]  # type: ignore[union-attr]
    assert list(dict.fromkeys(subtasks))[:2] == ["reach", "grasp"] and subtasks[-1] == "stay"


def test_boxes_enclose_the_visible_pixels_only() -> None:
    bodies = np.full((128, 128), -1, dtype=np.int32)
    bodies[10:21, 30:41] = 4
    assert reasoning.visible_box(bodies, 4) == (60, 20, 80, 40)
    assert reasoning.visible_box(bodies, 5) is None


def test_moves_form_a_closed_set() -> None:
    moves = reasoning.all_moves()
    assert len(moves) == len(set(moves)) == 30
    assert "move forward left down" in moves and "close gripper" in moves


def test_demonstrations_resume(tmp_path: Path) -> None:
    task = tasks.load()["widowx_stack_cube"]

    def demonstrate(episodes: int) -> tuple[int, int]:
        counts = demonstrations.demonstrate(
            [task], episodes, 40, tmp_path, noisy=False, processes=1, report=lambda line: None
        )
        return counts[task.name]

    first = demonstrate(1)
    path = tmp_path / task.name / "40.npz"
    stamp = path.stat().st_mtime_ns
    second = demonstrate(2)
    assert (first, second) == ((1, 0), (2, 0))
    assert path.stat().st_mtime_ns == stamp
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["40.npz", "41.npz"]
