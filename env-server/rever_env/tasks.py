"""The tasks: reads assets/tasks.toml into frozen dataclasses."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

from rever_env.fault import InvalidReset
from rever_env.protocol import Dimension

Triple = tuple[float, float, float]
Range = tuple[float, float]


@dataclass(frozen=True)
class Layout:
    """Where source and target start: metres in the world frame, yaw in degrees."""

    source_x: float
    source_y: float
    source_yaw: float
    target_x: float
    target_y: float


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
    index: int  # place in the file; part of the noise's seed
    variant: str
    version: int
    gymnasium_id: str
    instruction: str
    steps_max: int
    scene: Path
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


def load(assets: Path | None = None) -> dict[str, Task]:
    """All tasks by SIMPLER's name; unknown or missing keys in the file are errors."""
    folder = assets if assets is not None else _assets_folder()
    with open(folder / "tasks.toml", "rb") as file:
        description = tomllib.load(file)
    settings = WorldSettings(**_tuples(description["world"]))
    inverse_kinematics = InverseKinematics(**description["inverse_kinematics"])
    grasp = GraspRule(**description["grasp"])
    state, action = _dimensions(description["state"]), _dimensions(description["action"])
    tasks = {}
    for index, (name, table) in enumerate(description["tasks"].items()):
        fields = _tuples(table)
        fields["scene"] = folder / fields["scene"]
        fields["random"] = RandomRanges(**_tuples(fields["random"]))
        rows = fields.pop("grid")["layouts"]
        fields["layouts"] = tuple(Layout(*row) for row in rows)
        fields.setdefault("target_height", None)
        tasks[name] = Task(
            name=name,
            index=index,
            settings=settings,
            inverse_kinematics=inverse_kinematics,
            grasp=grasp,
            state=state,
            action=action,
            **fields,
        )
    return tasks


def _assets_folder() -> Path:
    """Inside an installed wheel the assets lie in the package, in the repository beside it."""
    package = Path(__file__).resolve().parent
    inside = package / "assets"
    return inside if inside.is_dir() else package.parent / "assets"


def _dimensions(rows: list[dict[str, Any]]) -> tuple[Dimension, ...]:
    return tuple(Dimension(discrete=False, **row) for row in rows)


def _tuples(table: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}


def choose(tasks: dict[str, Task], names: list[str] | None) -> list[Task]:
    """The named tasks in the file's order; all when no names are given."""
    unknown = [name for name in names or [] if name not in tasks]
    if unknown:
        raise InvalidReset(f"tasks {unknown}: expected some of {sorted(tasks)}")
    return [task for name, task in tasks.items() if not names or name in names]
