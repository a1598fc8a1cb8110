"""Success and other episode statistics, after SIMPLER's evaluate()."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env.protocol import Statistics
from rever_env.tasks import Task

Vector = NDArray[np.float64]


@dataclass
class Memory:
    """The memory of the statistics within an episode."""

    source_origin: Vector  # settled xy of the source's origin, metres
    target_origin: Vector
    distractor_origins: tuple[Vector, ...]
    source_half: Vector  # settled half extents, rotated as SIMPLER does, metres
    target_half: Vector
    grasped_steps: int = 0
    ever_grasped: bool = False
    consecutive_grasp: bool = False
    ever_success: bool = False


@dataclass(frozen=True)
class Touch:
    """Present contacts of the source: the force of each finger on it (N), and what it touches."""

    fingers: tuple[Vector, Vector]
    robot: bool
    target: bool
    elsewhere: bool


def success_alone(is_success: bool, ever_success: bool) -> Statistics:
    """Statistics of environments that report only success."""
    return Statistics(
        is_success=is_success,
        is_grasped=False,
        ever_grasped=False,
        consecutive_grasp=False,
        moved_correct_object=False,
        moved_wrong_object=False,
        source_on_target=is_success,
        ever_success=ever_success,
        released_success=False,
    )


class Judge:
    """Computes the statistics from contacts and poses."""

    def __init__(self, model: mujoco.MjModel, task: Task) -> None:
        self._model = model
        self._task = task
        self._source = model.body(task.source).id
        self._target = model.body(task.target).id
        self._distractors = [model.body(distractor.body).id for distractor in task.distractors]
        self._fingers = [model.body(name).id for name in task.settings.finger_bodies]
        robot_root = model.body(task.settings.robot_body).id
        self._is_robot = [_descends(model, body, robot_root) for body in range(model.nbody)]

    def begin(self, data: mujoco.MjData) -> Memory:
        """The memory of an episode whose objects have just settled."""
        return Memory(
            source_origin=data.xpos[self._source][:2].copy(),
            target_origin=data.xpos[self._target][:2].copy(),
            distractor_origins=tuple(data.xpos[body][:2].copy() for body in self._distractors),
            source_half=_half_extents(data.xquat[self._source], self._task.source_extents),
            target_half=_half_extents(data.xquat[self._target], self._task.target_extents),
        )

    def judge(self, data: mujoco.MjData, memory: Memory) -> Statistics:
        """The statistics of this step; updates the memory."""
        rule = self._task.grasp
        touch = self.touch(data)
        grasped = self.grasped(data, touch)
        memory.grasped_steps = memory.grasped_steps + 1 if grasped else 0
        memory.ever_grasped |= grasped
        memory.consecutive_grasp |= memory.grasped_steps >= rule.consecutive_steps
        # As in SIMPLER, this compares the settled origin with the present centre of mass, so that
        # the offset between the two is part of the source's displacement.
        source_moved = norm(data.xipos[self._source][:2] - memory.source_origin)
        others = zip(
            (self._target, *self._distractors),
            (memory.target_origin, *memory.distractor_origins),
            strict=True,
        )
        other_moved = max(norm(data.xpos[body][:2] - origin) for body, origin in others)
        on_target = self.on_target(data, memory, touch)
        memory.ever_success |= on_target
        return Statistics(
            is_success=on_target,
            is_grasped=grasped,
            ever_grasped=memory.ever_grasped,
            consecutive_grasp=memory.consecutive_grasp,
            moved_correct_object=source_moved > rule.moved_min and source_moved > other_moved,
            moved_wrong_object=other_moved > rule.moved_min and other_moved > source_moved,
            source_on_target=on_target,
            ever_success=memory.ever_success,
            released_success=on_target and not touch.robot and (touch.target or touch.elsewhere),
        )

    def touch(self, data: mujoco.MjData) -> Touch:
        """The contacts of the source whose impulse per physics step is above the threshold."""
        fingers = (np.zeros(3), np.zeros(3))
        touched: set[str] = set()
        wrench = np.zeros(6)
        force = np.zeros(3)
        contacts = data.contact
        frames = contacts.frame  # (contacts, 9)
        pairs = self._model.geom_bodyid[contacts.geom].tolist()  # (contacts, 2)
        for index, (first, second) in enumerate(pairs):
            if (first == self._source) == (second == self._source):
                continue
            other = second if first == self._source else first
            if self._is_robot[other]:
                kind = "robot"
            else:
                kind = "target" if other == self._target else "elsewhere"
            is_finger = other in self._fingers
            if kind in touched and not is_finger:
                continue  # one contact per kind is enough; an object on the table has many
            mujoco.mj_contactForce(self._model, data, index, wrench)
            if norm(wrench[:3]) * self._task.settings.timestep < self._task.grasp.impulse_min:
                continue
            touched.add(kind)
            if is_finger:
                mujoco.mju_mulMatTVec(force, frames[index].reshape(3, 3), wrench[:3])
                # The contact force acts on the second geom's body; flip it when that is the finger.
                sign = 1.0 if second == self._source else -1.0
                fingers[self._fingers.index(other)][:] += sign * force
        return Touch(fingers, "robot" in touched, "target" in touched, "elsewhere" in touched)

    def grasped(self, data: mujoco.MjData, touch: Touch) -> bool:
        """Both fingers press the source within 60 degrees of their closing direction."""
        rule = self._task.grasp
        cosine_min = math.cos(math.radians(rule.angle_max))
        for body, force, closing in zip(self._fingers, touch.fingers, (-1.0, 1.0), strict=True):
            magnitude = norm(force)
            if magnitude * self._task.settings.timestep < rule.impulse_min:
                return False
            axis = data.xmat[body].reshape(3, 3)[:, 1]
            along = closing * (axis[0] * force[0] + axis[1] * force[1] + axis[2] * force[2])
            if along < cosine_min * magnitude:
                return False
        return True

    def on_target(self, data: mujoco.MjData, memory: Memory, touch: Touch) -> bool:
        offset = data.xipos[self._source] - data.xipos[self._target]
        half = memory.target_half
        near = norm(offset[:2]) <= norm(half[:2]) + self._task.grasp.target_margin
        gap = offset[2] - half[2] - memory.source_half[2]
        above = offset[2] > 0.0 and gap <= self._task.height_offset_max
        if self._task.completely_on_target and touch.elsewhere:
            return False
        return bool(near and above)


def _half_extents(quaternion: Vector, extents: tuple[float, float, float]) -> Vector:
    """As in SIMPLER: the full extents, rotated as a vector with its signs, and halved."""
    rotated = np.zeros(3)
    mujoco.mju_rotVecQuat(rotated, np.array(extents), quaternion)
    return 0.5 * rotated


def _descends(model: mujoco.MjModel, body: int, ancestor: int) -> bool:
    while body != 0:
        if body == ancestor:
            return True
        body = int(model.body_parentid[body])
    return False


def norm(vector: Vector) -> float:
    """The Euclidean norm, summed in order, so that it is equal in every language."""
    total = 0.0
    for value in vector.tolist():  # sum() compensates its rounding from Python 3.12 on
        total += value * value
    return math.sqrt(total)
