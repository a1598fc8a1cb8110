"""Conversion of actions between the environment's convention, OpenVLA's convention, and bins.

Environment: dx dy dz in metres, a rotation vector in radians, gripper +1 open and -1 closed.
OpenVLA: the same translation, roll pitch yaw (sxyz, radians), gripper 1 open and 0 closed; the
first six are scaled so that the 1 % and 99 % quantiles become -1 and 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DIMENSIONS = 7
BINS = 256
EDGES: Array = np.linspace(-1.0, 1.0, BINS)
CENTRES: Array = (EDGES[:-1] + EDGES[1:]) / 2.0
# The first six are scaled by their quantiles, the gripper is not.
MASK = (True, True, True, True, True, True, False)
# Half of the minimum span of a scaled dimension: metres, then radians. The demonstrations hardly
# ever roll or pitch; without a minimum their numerical noise would fill all 256 bins.
SPAN_FLOOR: Array = np.array([0.005, 0.005, 0.005, 0.05, 0.05, 0.05])


@dataclass(frozen=True)
class Statistics:
    """`norm_stats[dataset].action` of config.json; each list has 7 entries."""

    q01: list[float]
    q99: list[float]
    mean: list[float]
    std: list[float]
    min: list[float]
    max: list[float]

    @classmethod
    def measure(cls, actions: Array) -> Statistics:
        """Statistics of (frames, 7) actions in OpenVLA's convention."""
        q01, q99 = np.quantile(actions, [0.01, 0.99], axis=0)
        q01[:6] = np.minimum(q01[:6], -SPAN_FLOOR)
        q99[:6] = np.maximum(q99[:6], SPAN_FLOOR)
        q01[6], q99[6] = 0.0, 1.0
        return cls(
            q01=q01.tolist(),
            q99=q99.tolist(),
            mean=actions.mean(axis=0).tolist(),
            std=actions.std(axis=0).tolist(),
            min=actions.min(axis=0).tolist(),
            max=actions.max(axis=0).tolist(),
        )

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> Statistics:
        return cls(**{name: value[name] for name in ("q01", "q99", "mean", "std", "min", "max")})

    def to_json(self) -> dict[str, Any]:
        return {"mask": list(MASK), **self.__dict__}


def digits_from_actions(actions: Array, statistics: Statistics) -> NDArray[np.int64]:
    """(frames, 7) in OpenVLA's convention -> digits 1..256, by OpenVLA's `digitize`."""
    low, high = np.array(statistics.q01), np.array(statistics.q99)
    scaled = np.where(MASK, 2.0 * (actions - low) / (high - low) - 1.0, actions)
    digits: NDArray[np.int64] = np.digitize(np.clip(scaled, -1.0, 1.0), EDGES)
    return digits


def actions_from_digits(digits: NDArray[np.int64], statistics: Statistics) -> Array:
    """(frames, 7) digits 1..256 -> OpenVLA's convention; 255 and 256 have the same centre."""
    centres = CENTRES[np.clip(digits - 1, 0, BINS - 2)]
    low, high = np.array(statistics.q01), np.array(statistics.q99)
    return np.where(MASK, 0.5 * (centres + 1.0) * (high - low) + low, centres)


def model_from_world(actions: Array) -> Array:
    """Environment's convention -> OpenVLA's, (frames, 7)."""
    result = np.array(actions, dtype=np.float64)
    result[:, 3:6] = euler_from_matrix(matrix_from_vector(actions[:, 3:6]))
    result[:, 6] = actions[:, 6] > 0.0
    return result


def world_from_model(actions: Array) -> Array:
    """OpenVLA's convention -> the environment's, (frames, 7)."""
    result = np.array(actions, dtype=np.float64)
    result[:, 3:6] = vector_from_matrix(matrix_from_euler(actions[:, 3:6]))
    result[:, 6] = np.where(actions[:, 6] > 0.5, 1.0, -1.0)
    return result


def matrix_from_vector(vectors: Array) -> Array:
    """Rodrigues' formula, (frames, 3) -> (frames, 3, 3)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    axis = vectors / np.maximum(angle[:, :, 0], 1e-12)
    zero = np.zeros(len(vectors))
    x, y, z = axis.T
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    matrices: Array = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return matrices


def vector_from_matrix(matrices: Array) -> Array:
    """Rotation vectors of rotation matrices, valid below half a turn, far above any action."""
    sine = 0.5 * np.stack(
        [
            matrices[:, 2, 1] - matrices[:, 1, 2],
            matrices[:, 0, 2] - matrices[:, 2, 0],
            matrices[:, 1, 0] - matrices[:, 0, 1],
        ],
        axis=1,
    )
    length = np.linalg.norm(sine, axis=1, keepdims=True)
    cosine = (np.trace(matrices, axis1=1, axis2=2)[:, None] - 1.0) / 2.0
    return sine * np.where(
        length < 1e-9, 1.0, np.arctan2(length, cosine) / np.maximum(length, 1e-9)
    )


def matrix_from_euler(angles: Array) -> Array:
    """Roll, pitch and yaw about the fixed x, y and z axes in this order (sxyz)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


def euler_from_matrix(matrices: Array) -> Array:
    roll = np.arctan2(matrices[:, 2, 1], matrices[:, 2, 2])
    pitch = np.arcsin(np.clip(-matrices[:, 2, 0], -1.0, 1.0))
    yaw = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    return np.stack([roll, pitch, yaw], axis=1)
