"""The scripted expert: picks the source object and places it on the target, without memory."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env.success import Judge, Memory, norm
from rever_env.tasks import Task

Vector = NDArray[np.float64]

GAIN = 0.6  # fraction of the remaining distance per action
MOVE_MAX = 0.035  # metres per step
TURN_MAX = 0.25  # rad per step
SLOPE = 3.0  # slope of the funnel over the goal: metres of height per metre of horizontal error
REACH_TOLERANCE = 0.005  # horizontal tolerance for the last descent, metres
CLOSE_TOLERANCE = 0.008  # tolerance for closing an open gripper
KEEP_CLOSING_TOLERANCE = 0.015  # the same while it is visibly closing
RISE_WHILE_CLOSING = 0.006  # metres per step while the fingers are visibly closing
RISEN_MAX = 0.025  # metres above the grasp: fingers closed up there have missed
PLACE_TOLERANCE = 0.006
HEIGHT_TOLERANCE = 0.006
TURN_TOLERANCE = 0.15  # rad
METRES_PER_RADIAN = 0.04  # weight of the yaw error against the horizontal error in the funnel
OPEN_MIN = 0.034  # finger joint position that counts as open, metres


class Stage(Protocol):
    """A running episode in MuJoCo, in any simulator; task has the names of its model."""

    @property
    def model(self) -> mujoco.MjModel: ...
    @property
    def data(self) -> mujoco.MjData: ...
    @property
    def task(self) -> Task: ...
    @property
    def judge(self) -> Judge: ...
    def running_memory(self) -> Memory:
        """The memory of the episode statistics."""
        ...


@dataclass(frozen=True)
class Sight:
    """The input of the expert; world frame, metres and radians."""

    tcp: Vector
    finger_angle: float  # heading of the finger axis
    finger_opening: float  # mean finger joint position
    source: Vector  # origin
    source_centre: Vector  # centre of mass
    source_angle: float
    target_centre: Vector
    target_origin: Vector
    held: bool
    on_target: bool
    world_from_base: NDArray[np.float64]  # (3, 3)


@dataclass(frozen=True)
class Decision:
    """An action, float64 (7,) in the env convention, and the subtask it serves."""

    action: Vector
    subtask: str  # one of SUBTASKS
    fine: bool  # a phase that needs precision: less noise is injected


SUBTASKS = ("reach", "grasp", "lift", "move", "release", "done")


def look(stage: Stage) -> Sight:
    """Reads the expert's input from a running episode; changes nothing."""
    model, data, task = stage.model, stage.data, stage.task
    memory = stage.running_memory()
    source, target = model.body(task.source).id, model.body(task.target).id
    site = model.site(task.settings.tcp).id
    touch = stage.judge.touch(data)
    source_axes = data.xmat[source].reshape(3, 3)
    finger_axes = data.site_xmat[site].reshape(3, 3)
    base = model.body(task.settings.robot_body).id
    fingers = [data.qpos[model.joint(name).qposadr[0]] for name in task.settings.finger_joints]
    return Sight(
        tcp=data.site_xpos[site].copy(),
        finger_angle=math.atan2(finger_axes[1, 1], finger_axes[0, 1]),
        finger_opening=float(fingers[0] + fingers[1]) / 2.0,
        source=data.xpos[source].copy(),
        source_centre=data.xipos[source].copy(),
        source_angle=math.atan2(source_axes[1, 0], source_axes[0, 0]),
        target_centre=data.xipos[target].copy(),
        target_origin=data.xpos[target].copy(),
        held=stage.judge.grasped(data, touch),
        on_target=stage.judge.on_target(data, memory, touch),
        world_from_base=data.xmat[base].reshape(3, 3).copy(),
    )


def decide(task: Task, sight: Sight) -> Decision:
    """One decision: a pure function of the sight."""
    if sight.held:
        return _carry(task, sight)
    if sight.on_target:
        return _leave(task, sight)
    return _fetch(task, sight)


def turn_error(task: Task, sight: Sight) -> float:
    """Angle from the finger axis to the source's short side, rad, by the source's symmetry.

    The interval is asymmetric (one third backwards, two thirds forwards), so that the expert always
    turns the same way for a source that lies across, where both ways are equally long.
    """
    period = math.radians(task.grasp_symmetry)
    error = sight.source_angle + math.pi / 2.0 - sight.finger_angle
    return (error + period / 3.0) % period - period / 3.0


def _fetch(task: Task, sight: Sight) -> Decision:
    """Moves above the source, descends through the funnel, and closes the gripper."""
    turned = _turned(task.grasp_offset, sight.source_angle)
    goal = sight.source + turned
    away = norm((goal - sight.tcp)[:2])
    turn = turn_error(task, sight)
    above = float(sight.tcp[2] - goal[2])
    is_open = sight.finger_opening >= OPEN_MIN
    tolerance = CLOSE_TOLERANCE if is_open else KEEP_CLOSING_TOLERANCE
    risen_max = HEIGHT_TOLERANCE if is_open else RISEN_MAX
    if (
        away <= tolerance
        and -HEIGHT_TOLERANCE <= above <= risen_max
        and abs(turn) <= TURN_TOLERANCE
    ):
        # Closing and closed fingers look alike in a small image. If the label depended on the
        # difference, a trained policy would wait with the source in its hand: both mean up.
        rise = 0.0 if is_open else RISE_WHILE_CLOSING / GAIN
        return _decision(sight, np.array([0.0, 0.0, rise]), 0.0, -1.0, "grasp", fine=True)
    error = max(away, METRES_PER_RADIAN * abs(turn))
    height = min(task.hover, SLOPE * max(0.0, error - REACH_TOLERANCE))
    if not is_open:
        height = max(height, task.hover / 2.0)  # open again before descending
    move = goal + np.array([0.0, 0.0, height]) - sight.tcp
    # Below the funnel the fingers could push the source away: rise before moving sideways.
    low = max(0.0, height - above)
    move[:2] *= _fade(low, 0.015, 0.04)
    return _decision(sight, move, turn, 1.0, "reach", fine=error < 0.03)


def _carry(task: Task, sight: Sight) -> Decision:
    """Lifts, moves above the target, descends through the funnel, and opens the gripper."""
    rest = sight.target_origin[2] + task.target_top + task.source_bottom
    place = rest + task.release_gap
    away = sight.target_centre[:2] - sight.source_centre[:2]
    error = norm(away)
    above = float(sight.source[2] - place)
    if error <= PLACE_TOLERANCE + 0.003 and above <= HEIGHT_TOLERANCE:
        return _decision(sight, np.zeros(3), 0.0, 1.0, "release", fine=True)
    carry = task.hover - task.release_gap
    height = min(carry, SLOPE * max(0.0, error - PLACE_TOLERANCE))
    low = max(0.0, height - above)
    sideways = _fade(low, 0.015, 0.04)
    move = np.array([away[0] * sideways, away[1] * sideways, height - above])
    subtask = "release" if error < 0.02 else "move" if low < 0.025 else "lift"
    return _decision(sight, move, 0.0, -1.0, subtask, fine=error < 0.03 or subtask == "lift")


def _leave(task: Task, sight: Sight) -> Decision:
    """Opens the gripper fully, rises, and holds still."""
    if sight.finger_opening < OPEN_MIN:
        return _decision(sight, np.zeros(3), 0.0, 1.0, "release", fine=True)
    rise = sight.source[2] + task.hover - float(sight.tcp[2])
    if rise < 0.012:
        return _decision(sight, np.zeros(3), 0.0, 1.0, "done", fine=True)
    return _decision(sight, np.array([0.0, 0.0, rise]), 0.0, 1.0, "done", fine=True)


def _decision(
    sight: Sight, move: Vector, turn: float, gripper: float, subtask: str, *, fine: bool
) -> Decision:
    """Scales the remaining motion to one action in the base frame, without roll and pitch."""
    step = GAIN * move
    length = norm(step)
    if length > MOVE_MAX:
        step = step * (MOVE_MAX / length)
    yaw = min(max(GAIN * turn, -TURN_MAX), TURN_MAX)
    action = np.zeros(7)
    mujoco.mju_mulMatTVec(action[:3], sight.world_from_base, step)
    action[5] = yaw  # the base's z axis is the world's
    action[6] = gripper
    return Decision(action, subtask, fine)


def _turned(offset: tuple[float, float, float], angle: float) -> Vector:
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y, z = offset
    return np.array([cosine * x - sine * y, sine * x + cosine * y, z])


def _fade(value: float, full: float, none: float) -> float:
    """1 up to `full`, 0 from `none` on, linear in between."""
    return min(max((none - value) / (none - full), 0.0), 1.0)
