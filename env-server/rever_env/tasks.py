"""The tasks and their variants: reads assets/tasks.toml into frozen dataclasses."""

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from rever_env.fault import InvalidReset
from rever_env.protocol import Dimension

Triple = tuple[float, float, float]
Range = tuple[float, float]

DEFAULT = "default"  # the variant of a task as its own table describes it
ALL = "all"  # in place of a variant's or a task's name: every one of them
BRIDGE = "bridge"  # the same, where other tasks can be named beside these
_TABLE, _TEXT = "a table", "a text"


class TaskId(NamedTuple):
    """A task in one of its variants. Its text is TASK, or TASK/VARIANT for another than default."""

    task: str
    variant: str = DEFAULT

    def __str__(self) -> str:
        return self.task if self.variant == DEFAULT else f"{self.task}/{self.variant}"

    @classmethod
    def parse(cls, text: str) -> "TaskId":
        """TASK or TASK/VARIANT; a task's own name may hold slashes, as in ALE/Pong-v5/default."""
        task, slash, variant = text.rpartition("/")
        return cls(task, variant) if slash else cls(text)


class Pose(NamedTuple):
    """Where a distractor starts: metres in the world frame, yaw in degrees."""

    x: float
    y: float
    yaw: float


@dataclass(frozen=True)
class Layout:
    """Where the objects start: metres in the world frame, yaw in degrees."""

    source_x: float
    source_y: float
    source_yaw: float
    target_x: float
    target_y: float
    distractors: tuple[Pose, ...] = ()


@dataclass(frozen=True)
class Distractor:
    """An object that the task does not ask for: a body of the scene with a free joint of its name.

    x, y and yaw bound random layouts, in which it keeps separation_min from every other object.
    """

    body: str
    height: float
    x: Range
    y: Range
    yaw: Range
    separation_min: float


@dataclass(frozen=True)
class MjcfChange:
    """An attribute of one named element of the scene, set before the scene is compiled."""

    element: str  # geom, body, inertial ...
    name: str
    attribute: str
    value: str  # as in MJCF


@dataclass(frozen=True)
class RandomRanges:
    """The box random layouts are drawn from, and what is kept out of it."""

    source_x: Range
    source_y: Range
    source_yaw: Range
    target_x: Range
    target_y: Range
    separation_min: float
    exclusion_radius: float
    exclusion_yaw: float


@dataclass(frozen=True)
class WorldSettings:
    """Physics and control settings shared by all tasks; units as in tasks.toml."""

    timestep: float
    substeps: int
    ramp: float
    gripper_closed: float
    gripper_open: float
    settle: float
    settle_extra: float
    settle_speed_max: float
    settle_spin_max: float
    camera: str
    tcp: str
    arm_joints: tuple[str, ...]
    finger_joints: tuple[str, ...]
    finger_bodies: tuple[str, ...]
    robot_body: str


@dataclass(frozen=True)
class InverseKinematics:
    """Settings of the damped least squares solver."""

    damping: float
    iterations_max: int
    tolerance: float
    failure: float


@dataclass(frozen=True)
class GraspRule:
    """SIMPLER's thresholds for grasped and moved."""

    impulse_min: float
    angle_max: float
    consecutive_steps: int
    moved_min: float
    target_margin: float


@dataclass(frozen=True)
class Task:
    """One task in one variant, complete: nothing else decides what an episode is."""

    name: str
    variant: str
    index: int  # the task's place in the file, the same for its variants; part of the noise's seed
    version: int
    gymnasium_id: str
    instruction: str
    steps_max: int
    scene: Path
    mjcf: tuple[MjcfChange, ...]
    robot_joints: tuple[float, ...]
    source: str
    target: str
    source_phrase: str
    target_phrase: str
    source_extents: Triple
    target_extents: Triple
    height_offset_max: float
    completely_on_target: bool
    source_height: float
    target_height: float | None
    grasp_offset: Triple
    grasp_symmetry: float
    source_bottom: float
    target_top: float
    hover: float
    release_gap: float
    distractors: tuple[Distractor, ...]
    random: RandomRanges
    layouts: tuple[Layout, ...]
    settings: WorldSettings
    inverse_kinematics: InverseKinematics
    grasp: GraspRule
    state: tuple[Dimension, ...]
    action: tuple[Dimension, ...]

    @property
    def control_hz(self) -> float:
        """Control steps per second of simulated time."""
        return 1.0 / (self.settings.timestep * self.settings.substeps)

    @property
    def id(self) -> TaskId:
        """Task and variant."""
        return TaskId(self.name, self.variant)


def load(assets: Path | None = None) -> dict[str, Task]:
    """All tasks in all variants by the text of their id, in the file's order.

    Each task is followed by its variants. ValueError names an unknown or missing key.
    """
    folder = assets if assets is not None else _assets_folder()
    path = folder / "tasks.toml"
    with open(path, "rb") as file:
        description = tomllib.load(file)
    try:
        return {str(task.id): task for task in _tasks(description, folder)}
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def find(tasks: Mapping[str, Task], name: str, variant: str = DEFAULT) -> Task:
    """One task in one variant; InvalidReset says which there are."""
    task = tasks.get(str(TaskId(name, variant)))
    if task is not None:
        return task
    variants = [task.variant for task in tasks.values() if task.name == name]
    if variants:
        raise InvalidReset(
            f"task {name}: expected one of the variants {', '.join(variants)}, got {variant!r}"
        )
    raise InvalidReset(f"expected one of the tasks {', '.join(tasks)}, got {name!r}")


def choose(tasks: Mapping[str, Task], names: Iterable[str] | None) -> list[Task]:
    """The named tasks in the file's order; every task in its default variant without names.

    A name is TASK, TASK/VARIANT, TASK/all, or all: every variant of the task, or of every task.
    """
    if names is None:
        return [task for task in tasks.values() if task.variant == DEFAULT]
    chosen: set[TaskId] = set()
    for name in names:
        wanted = TaskId(ALL, ALL) if name == ALL else TaskId.parse(name)
        found = {
            task.id
            for task in tasks.values()
            if wanted.task in (ALL, task.name) and wanted.variant in (ALL, task.variant)
        }
        if not found:
            raise InvalidReset(f"task {name}: expected one of {', '.join(tasks)}")
        chosen |= found
    return [task for task in tasks.values() if task.id in chosen]


def _assets_folder() -> Path:
    """Inside an installed wheel the assets lie in the package, in the repository beside it."""
    package = Path(__file__).resolve().parent
    inside = package / "assets"
    return inside if inside.is_dir() else package.parent / "assets"


def _tasks(description: dict[str, Any], folder: Path) -> Iterable[Task]:
    tables = dict(description.pop("tasks"))
    shared = {
        "settings": _made(WorldSettings, "world", description.pop("world")),
        "inverse_kinematics": _made(
            InverseKinematics, "inverse_kinematics", description.pop("inverse_kinematics")
        ),
        "grasp": _made(GraspRule, "grasp", description.pop("grasp")),
        "state": _dimensions("state", description.pop("state")),
        "action": _dimensions("action", description.pop("action")),
    }
    if description:
        raise ValueError(f"unknown table {next(iter(description))!r}")
    for index, (name, table) in enumerate(tables.items()):
        where = f"tasks.{name}"
        task = dict(table)
        variants = task.pop("variants", {})
        if DEFAULT in variants:
            raise ValueError(f"{where}.variants.{DEFAULT}: expected it in the task's own table")
        for variant, changes in {DEFAULT: {}, **variants}.items():
            place = where if variant == DEFAULT else f"{where}.variants.{variant}"
            identity = {"name": name, "variant": variant, "index": index}
            yield _task(place, _merged(place, task, changes), {**identity, **shared}, folder)


def _merged(where: str, task: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """The task's table with a variant's fields in place of its own, key by key in tables."""
    merged = dict(task)
    for key, value in changes.items():
        own = task.get(key)
        if own is not None and _kind(own) != _kind(value):
            raise ValueError(f"{where}.{key}: expected {_kind(own)}, got {_kind(value)}")
        merged[key] = _merged(f"{where}.{key}", own, value) if isinstance(own, dict) else value
    return merged


def _task(where: str, table: dict[str, Any], given: dict[str, Any], folder: Path) -> Task:
    """given: what is not in the task's own table."""
    own = {field.name for field in fields(Task)} - {*given, "layouts"} | {"grid"}
    _check_keys(where, table, own, optional={"target_height", "distractors", "mjcf"})
    _check_keys(f"{where}.grid", table["grid"], {"layouts"})
    rows = _rows(f"{where}.grid.layouts", table["grid"]["layouts"], 5)
    distractors, poses = [], []
    for index, distractor in enumerate(table.get("distractors", [])):
        place = f"{where}.distractors[{index}]"
        starts = _rows(f"{place}.layouts", distractor.get("layouts", []), 3, len(rows))
        poses.append([Pose(*start) for start in starts])
        rest = {key: value for key, value in distractor.items() if key != "layouts"}
        distractors.append(_made(Distractor, place, rest))
    values = {
        **_tuples(table),
        "scene": folder / table["scene"],
        "mjcf": tuple(_changes(f"{where}.mjcf", table.get("mjcf", {}))),
        "target_height": table.get("target_height"),
        "distractors": tuple(distractors),
        "random": _made(RandomRanges, f"{where}.random", table["random"]),
        "layouts": tuple(
            replace(Layout(*row), distractors=tuple(starts[index] for starts in poses))
            for index, row in enumerate(rows)
        ),
    }
    del values["grid"]
    return Task(**given, **values)


def _changes(where: str, table: dict[str, Any]) -> Iterable[MjcfChange]:
    """Of a table element -> name -> attribute -> value."""
    for element, names in table.items():
        for name, attributes in _expect(f"{where}.{element}", names, _TABLE).items():
            place = f"{where}.{element}.{name}"
            for attribute, value in _expect(place, attributes, _TABLE).items():
                text = _expect(f"{place}.{attribute}", value, _TEXT)
                yield MjcfChange(element, name, attribute, text)


def _made(kind: type[Any], where: str, table: dict[str, Any]) -> Any:
    """The dataclass with the table's values; ValueError for a key too many or too few."""
    _check_keys(where, table, {field.name for field in fields(kind)})
    return kind(**_tuples(table))


def _check_keys(
    where: str,
    table: dict[str, Any],
    known: set[str],
    *,
    optional: frozenset[str] | set[str] = frozenset(),
) -> None:
    for key in table:
        if key not in known:
            raise ValueError(f"{where}: unknown key {key!r}: expected some of {sorted(known)}")
    for key in sorted(known - optional):
        if key not in table:
            raise ValueError(f"{where}: missing key {key!r}")


def _rows(where: str, rows: Any, length: int, count: int | None = None) -> list[Any]:
    """The rows, each of so many numbers, and so many of them where it is given."""
    if count is not None and len(rows) != count:
        raise ValueError(f"{where}: expected {count} rows, one per layout, got {len(rows)}")
    for row in rows:
        if len(row) != length:
            raise ValueError(f"{where}: expected rows of {length} numbers, got {row}")
    return list(rows)


def _expect(where: str, value: Any, kind: str) -> Any:
    if _kind(value) != kind:
        raise ValueError(f"{where}: expected {kind}, got {_kind(value)}")
    return value


def _kind(value: Any) -> str:
    """What a value of TOML is, in words."""
    if isinstance(value, list) and all(type(each) in (int, float) for each in value):
        return f"{len(value)} numbers"
    kinds = {bool: "a truth value", int: "a number", float: "a number", str: _TEXT, dict: _TABLE}
    return kinds.get(type(value), f"a {type(value).__name__}")


def _dimensions(where: str, rows: list[dict[str, Any]]) -> tuple[Dimension, ...]:
    for row in rows:
        _check_keys(where, row, {"name", "low", "high"})
    return tuple(Dimension(discrete=False, **row) for row in rows)


def _tuples(table: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
