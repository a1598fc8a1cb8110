"""info["action_followed"]: whether the gripper follows its actions, from the observed states."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rever_env.protocol import Dimension

Vector = NDArray[np.float64]

_STATE = ("x", "y", "z", "roll", "pitch", "yaw")
_ACTION = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")
# Fraction of the way to the commanded pose that may remain after a step. The largest actions take
# more than one step; an arm that holds still, because its target is out of reach, leaves all.
_SHARE_LEFT_MAX = 0.7
_METRES_LEFT_MAX = 0.005
_RADIANS_LEFT_MAX = 0.03


def is_pose_controlled(state: Sequence[Dimension], action: Sequence[Dimension]) -> bool:
    """Whether state and action are those of the Bridge tasks: a pose, and a change of it."""
    return (
        tuple(one.name for one in state[:6]) == _STATE
        and tuple(one.name for one in action[:6]) == _ACTION
    )


class CommandedPose:
    """The pose that the actions of an episode add up to, in the base's frame.

    The controller moves the commanded pose by each action and steers to it: position p + dp +
    dR (p_commanded - p), attitude dR R_commanded. The next action starts from the commanded pose,
    so that a pose out of reach remains the target until actions bring it back.
    """

    def __init__(self, state: NDArray[np.float32]) -> None:
        """state: the state after reset, before the first action."""
        self._measured, self._measured_attitude = _pose(state)
        self._position, self._attitude = self._measured, self._measured_attitude

    def follow(self, action: NDArray[np.float32], state: NDArray[np.float32]) -> bool:
        """Whether the gripper followed this action in the step that led to this state."""
        numbers = action.astype(np.float64)
        turn = _turn(numbers[3:6])
        now = self._measured
        self._position = now + numbers[:3] + turn @ (self._position - now)
        self._attitude = turn @ self._attitude
        before = self._left()
        self._measured, self._measured_attitude = _pose(state)
        metres, radians = self._left()
        return (
            metres <= _SHARE_LEFT_MAX * before[0] + _METRES_LEFT_MAX
            and radians <= _SHARE_LEFT_MAX * before[1] + _RADIANS_LEFT_MAX
        )

    def _left(self) -> tuple[float, float]:
        """Distance from the measured to the commanded pose in metres and radians."""
        offset = self._position - self._measured
        cosine = (float(np.sum(self._attitude * self._measured_attitude)) - 1.0) / 2.0
        return math.sqrt(float(offset @ offset)), math.acos(min(max(cosine, -1.0), 1.0))


def _pose(state: NDArray[np.float32]) -> tuple[Vector, Vector]:
    """Position (3,) and attitude (3, 3)."""
    x, y, z, roll, pitch, yaw = state[:6].tolist()
    about_x, about_y, about_z = (
        _turn(np.array(vector)) for vector in ((roll, 0.0, 0.0), (0.0, pitch, 0.0), (0.0, 0.0, yaw))
    )
    return np.array([x, y, z]), about_z @ about_y @ about_x


def _turn(vector: Vector) -> Vector:
    """The rotation matrix (3, 3) of a rotation vector in radians."""
    angle = math.sqrt(float(vector @ vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = (vector / angle).tolist()
    sine, rest = math.sin(angle), 1.0 - math.cos(angle)
    return np.array(
        [
            [1.0 - rest * (y * y + z * z), rest * x * y - sine * z, rest * x * z + sine * y],
            [rest * x * y + sine * z, 1.0 - rest * (x * x + z * z), rest * y * z - sine * x],
            [rest * x * z - sine * y, rest * y * z + sine * x, 1.0 - rest * (x * x + y * y)],
        ]
    )
