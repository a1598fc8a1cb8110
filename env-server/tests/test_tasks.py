"""The tasks as data: what a variant changes and what it leaves, and what is refused by name."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import TASKS

from rever_env import mjcf, tasks
from rever_env.fault import InvalidReset
from rever_env.layout import place
from rever_env.tasks import MjcfChange, Task, TaskId
from rever_env.world import World

CARROT = "widowx_carrot_on_plate"
SPOON = "widowx_spoon_on_towel"
HOLD = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
ASSETS = Path(__file__).resolve().parent.parent / "assets"
WORDED = f"[tasks.{SPOON}.variants.paraphrase]"
HALF = f'[tasks.{CARROT}.variants."size-0.5"]'


def read(folder: Path, before: str, after: str) -> dict[str, Task]:
    """The tasks with another text in one place of tasks.toml."""
    text = (ASSETS / "tasks.toml").read_text(encoding="utf-8")
    assert text.count(before) == 1
    (folder / "tasks.toml").write_text(text.replace(before, after), encoding="utf-8")
    return tasks.load(folder)


def test_the_text_of_an_id_can_be_read_again() -> None:
    for task in TASKS.values():
        assert TaskId.parse(str(task.id)) == task.id
    assert TaskId.parse("a/default") == TaskId("a") == TaskId.parse("a")
    assert TaskId.parse("a/b/c") == TaskId("a/b", "c")
    assert (str(TaskId("a")), str(TaskId("a", "b"))) == ("a", "a/b")


def test_a_variant_is_its_task_but_for_the_fields_that_it_names() -> None:
    changed = {
        f"{CARROT}/size-0.5": {
            "mjcf",
            "source_extents",
            "source_height",
            "grasp_offset",
            "source_bottom",
        },
        f"{SPOON}/paraphrase": {"instruction"},
        f"{SPOON}/distractors": {"scene", "distractors", "layouts"},
    }
    variants = {name for name, task in TASKS.items() if task.variant != tasks.DEFAULT}
    assert variants == changed.keys()
    for name, fields in changed.items():
        task = TASKS[name]
        values = {field: getattr(task, field) for field in fields | {"variant"}}
        default = TASKS[task.name]
        assert replace(default, **values) == task
        assert all(value != getattr(default, field) for field, value in values.items())


def test_tasks_are_chosen_by_id_and_by_group() -> None:
    def chosen(*names: str) -> list[str]:
        return [str(task.id) for task in tasks.choose(TASKS, names or None)]

    spoons = [name for name in TASKS if name.startswith(SPOON)]
    assert chosen() == [task.name for task in TASKS.values() if task.variant == tasks.DEFAULT]
    assert chosen(SPOON) == chosen(f"{SPOON}/default") == [SPOON]
    assert chosen(f"{SPOON}/all", f"{SPOON}/paraphrase") == spoons and len(spoons) == 3
    assert chosen("all") == list(TASKS)
    for name in ("fold", f"{SPOON}/upside-down"):
        with pytest.raises(InvalidReset, match=f"task {name}: expected one of {SPOON}"):
            chosen(name)
    with pytest.raises(InvalidReset, match="variants default, paraphrase, distractors, got 'x'"):
        tasks.find(TASKS, SPOON, "x")


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        (HALF, f"{HALF}\nhight = 1", "tasks.*size-0.5: unknown key 'hight': expected some of"),
        (HALF, f"{HALF}\nrandom.speed = 1", "size-0.5.random: unknown key 'speed'"),
        (HALF, f"{HALF}\nindex = 1", "size-0.5: unknown key 'index'"),
        (HALF, f"{HALF}\nvariants.x.hover = 1", "size-0.5: unknown key 'variants'"),
        (HALF, f"{HALF}\nhover = true", "hover: expected a number, got a boolean"),
        (HALF, f"{HALF}\ntarget_extents = [1, 2]", "expected 3 numbers, got 2 numbers"),
        (WORDED, f"{WORDED}\nmjcf.geom.a.size = 1", "geom.a.size: expected a text, got a number"),
        (WORDED, f"{WORDED}\nmjcf.geom.a = 1", "geom.a: expected a table, got a number"),
        (HALF, f"[tasks.{CARROT}.variants.default]", "default: expected it in the task's own"),
        (HALF, f"{HALF}\n[[tasks.{CARROT}.variants.x.distractors]]\nlayouts = []", "expected 24"),
        ('body = "plate"\n', "", r"distractors\[1\]: missing key 'body'"),
        ('body = "plate"\n', 'body = "plate"\nmass = 1\n', r"\[1\]: unknown key 'mass'"),
        ("timestep = 0.002\n", "timestep = 0.002\nspeed = 1\n", "world: unknown key 'speed'"),
        ("hover = 0.09", "", "eggplant_in_basket: missing key 'hover'"),
    ],
)
def test_what_is_wrong_in_the_file_is_named(
    tmp_path: Path, before: str, after: str, words: str
) -> None:
    with pytest.raises(ValueError, match=rf"tasks.toml: .*{words}"):
        read(tmp_path, before, after)


def test_a_change_sets_the_attribute_of_the_named_element_alone() -> None:
    default, half = (mjcf.compile(TASKS[name]) for name in (CARROT, f"{CARROT}/size-0.5"))
    for index in range(default.ngeom):
        scale = 0.5 if default.geom(index).name.startswith("carrot") else 1.0
        # A capsule's number for the third axis is nought, and so is its half.
        assert half.geom_size[index] == pytest.approx(scale * default.geom_size[index], abs=1e-9)
        assert half.geom_pos[index] == pytest.approx(scale * default.geom_pos[index], abs=1e-9)
        assert half.geom_quat[index] == pytest.approx(default.geom_quat[index], abs=1e-6)
    mass = np.where(np.arange(default.nbody) == default.body("carrot").id, 0.125, 1.0)
    assert half.body_mass == pytest.approx(mass * default.body_mass)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (MjcfChange("geom", "turnip", "size", "1"), "expected one geom named turnip, got 0"),
        # What has no name goes by its parent's, if that tells which one.
        (MjcfChange("geom", "plate", "size", "1"), "expected one geom named plate, got 4"),
        (MjcfChange("geom", "carrot_head", "hight", "1"), "hight"),
    ],
)
def test_a_change_that_does_not_fit_the_scene_is_named(change: MjcfChange, words: str) -> None:
    task = replace(TASKS[CARROT], mjcf=(change,))
    with pytest.raises(ValueError, match=words):
        mjcf.compile(task)


@pytest.mark.parametrize("name", list(TASKS))
def test_a_scene_in_one_text_is_the_model_of_its_files(name: str, tmp_path: Path) -> None:
    task = replace(TASKS[name], mjcf=())
    models = mjcf.compile(task), mujoco.MjModel.from_xml_path(str(task.scene))
    files = [tmp_path / f"{index}.mjb" for index in range(2)]
    for model, file in zip(models, files, strict=True):
        mujoco.mj_saveModel(model, str(file))
    assert files[0].read_bytes() == files[1].read_bytes()


def test_distractors_leave_source_and_target_where_they_were_and_keep_apart() -> None:
    plain, crowded = TASKS[SPOON], TASKS[f"{SPOON}/distractors"]
    for layout, seed in [*((index, 0) for index in range(24)), *((None, 7 * i) for i in range(50))]:
        placed = place(crowded, layout, seed)
        assert replace(placed, distractors=()) == place(plain, layout, seed)
        points = [(placed.source_x, placed.source_y), (placed.target_x, placed.target_y)]
        for distractor, pose in zip(crowded.distractors, placed.distractors, strict=True):
            away = min(np.hypot(pose.x - x, pose.y - y) for x, y in points)
            assert away >= distractor.separation_min
            points.append((pose.x, pose.y))
            if layout is None:
                ranges = (distractor.x, distractor.y, distractor.yaw)
                for number, (low, high) in zip(pose, ranges, strict=True):
                    assert low <= number <= high


def test_moving_a_distractor_counts_as_the_wrong_object() -> None:
    with World(TASKS[f"{SPOON}/distractors"], 0, 0) as world:
        for body in ("carrot", "plate"):
            world.reset(layout=0, seed=0)
            statistics = world.step(HOLD).statistics
            assert not statistics.moved_wrong_object
            world.data.qpos[world.model.joint(body).qposadr[0]] += 0.04
            mujoco.mj_forward(world.model, world.data)
            saved = world.save()
            for _ in range(2):
                statistics = world.step(HOLD).statistics
                assert statistics.moved_wrong_object and not statistics.moved_correct_object
                world.restore(saved)


def test_another_wording_changes_the_words_alone() -> None:
    with World(TASKS[SPOON]) as plain, World(TASKS[f"{SPOON}/paraphrase"]) as worded:
        for layout, seed in ((3, 0), (None, 5)):
            seen, told = (world.reset(layout=layout, seed=seed) for world in (plain, worded))
            assert np.array_equal(seen.image, told.image)
            assert np.array_equal(seen.state, told.state)
            assert told.instruction == "place the spoon onto the towel" != seen.instruction
