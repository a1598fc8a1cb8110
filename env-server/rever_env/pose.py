"""The pose of a gripper in the frame of the robot's base."""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def in_base(
    base: Vector, base_axes: Vector, position: Vector, axes: Vector, reference: Vector | None = None
) -> tuple[float, ...]:
    """x y z (m) and roll pitch yaw (rad) of a frame in the base frame.

    axes: 9 numbers or (3, 3). reference, (3, 3): the attitude that counts as zero. MuJoCo computes
    the products, because numpy may sum in another order on another processor.
    """
    base_axes = base_axes.reshape(3, 3)
    translation, attitude = np.zeros(3), np.zeros((3, 3))
    mujoco.mju_mulMatTVec(translation, base_axes, position - base)
    mujoco.mju_mulMatTMat(attitude, base_axes, np.ascontiguousarray(axes.reshape(3, 3)))
    if reference is not None:
        turned = np.zeros((3, 3))
        mujoco.mju_mulMatMatT(turned, attitude, reference)
        attitude = turned
    (xx, _, _), (yx, _, _), (zx, zy, zz) = attitude.tolist()
    roll = math.atan2(zy, zz)
    pitch = math.atan2(-zx, math.sqrt(zy * zy + zz * zz))
    yaw = math.atan2(yx, xx)
    return (*translation.tolist(), roll, pitch, yaw)
