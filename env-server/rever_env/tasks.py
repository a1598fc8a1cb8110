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

DEFAULT = "default"  # the variant that the task's own table describes
ALL = "all"  # in place of the name of a variant or task: all of them
BRIDGE = "bridge"  # all Bridge tasks, where tasks of other simulators can be named as well
_TABLE, _TEXT = "a table", "a text"


class TaskId(NamedTuple):
    """A task in a variant. As text: TASK, or TASK/VARIANT unless it is the default variant."""

    task: str
    variant: str = DEFAULT

    def __str__(self) -> str:
        return self.task if self.variant == DEFAULT else f"{self.task}/{self.variant}"

    @classmethod
    def parse(cls, text: str) -> "TaskId":
        """Parses TASK or TASK/VARIANT. A task's name may have slashes: ALE/Pong-v5/default."""
        task, slash, variant = text.rpartition("/")
        return cls(task, variant) if slash else cls(text)


class Pose(NamedTuple):
    """The initial pose of a distractor: metres in the world frame, yaw in degrees."""

    x: float
    y: float
    yaw: float


@dataclass(frozen=True)
class Layout:
    """The initial poses of the objects: metres in the world frame, yaw in degrees."""

    source_x: float
    source_y: float
    source_yaw: float
    target_x: float
    target_y: float
    distractors: tuple[Pose, ...] = ()


@dataclass(frozen=True)
class Distractor:
    """An object irrelevant to the task: a body of the scene with a free joint of the same name.

    x, y and yaw bound random layouts; separation_min is its distance to all other objects in them.
    """

    body: str
    height: float
    x: Range
    y: Range
    yaw: Range
    separation_min: float


@dataclass(frozen=True)
class MjcfChange:
    """A changed attribute of a named element of the scene, set before the scene is compiled."""

    element: str  # geom, body, inertial ...
    name: str
    attribute: str
    value: str  # as in MJCF


@dataclass(frozen=True)
class RandomRanges:
    """The box that random layouts are drawn from, and the distances they keep."""

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
    """Physics and control settings of all tasks; units as in tasks.toml."""

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
    """A task in a variant: the complete description of its episodes."""

    name: str
    variant: str
    index: int  # index of the task in the file, the same for its variants; part of the noise seed
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
    """All tasks in all variants by the text of their id, in the order of the file.

    Each task is followed by its variants. ValueError for an unknown or missing key.
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
    """The task in this variant; InvalidReset names the known ones."""
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
    """The named tasks in the order of the file; without names, all tasks in their default variant.

    names: TASK, TASK/VARIANT, TASK/all (all variants of the task), or all (all variants of all
    tasks). InvalidReset for an unknown name.
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
    """The folder assets: inside an installed package, beside the package in the repository."""
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
    """The task's table with the variant's fields replaced, key by key inside tables."""
    merged = dict(task)
    for key, value in changes.items():
        own = task.get(key)
        if own is not None and _kind(own) != _kind(value):
            raise ValueError(f"{where}.{key}: expected {_kind(own)}, got {_kind(value)}")
        merged[key] = _merged(f"{where}.{key}", own, value) if isinstance(own, dict) else value
    return merged


def _task(where: str, table: dict[str, Any], given: dict[str, Any], folder: Path) -> Task:
    """given: the fields that are not in the task's own table."""
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
    """Changes from a table element -> name -> attribute -> value."""
    for element, names in table.items():
        for name, attributes in _expect(f"{where}.{element}", names, _TABLE).items():
            place = f"{where}.{element}.{name}"
            for attribute, value in _expect(place, attributes, _TABLE).items():
                text = _expect(f"{place}.{attribute}", value, _TEXT)
                yield MjcfChange(element, name, attribute, text)


def _made(kind: type[Any], where: str, table: dict[str, Any]) -> Any:
    """A dataclass from a table; ValueError for an unknown or missing key."""
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
    """The rows, each with `length` numbers; `count` rows, if it is given."""
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
    """The name of a TOML value's type."""
    if isinstance(value, list) and all(type(each) in (int, float) for each in value):
        return f"{len(value)} numbers"
    kinds = {bool: "a boolean", int: "a number", float: "a number", str: _TEXT, dict: _TABLE}
    return kinds.get(type(value), f"a {type(value).__name__}")


def _dimensions(where: str, rows: list[dict[str, Any]]) -> tuple[Dimension, ...]:
    for row in rows:
        _check_keys(where, row, {"name", "low", "high"})
    return tuple(Dimension(discrete=False, **row) for row in rows)


def _tuples(table: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}
