"""Snapshots: the complete state of an episode as bytes, bit-exact."""

import hashlib
import struct

import mujoco
import numpy as np

from rever_env.controller import Controller
from rever_env.fault import Fault
from rever_env.success import Memory
from rever_env.tasks import Task

_MAGIC = b"rever-snapshot-1"
_HEADER = struct.Struct("<16s16sIIIBBB")  # magic, task digest, steps, grasped steps, floats, flags
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class InvalidSnapshot(Fault):
    """The bytes are not a snapshot of this task."""


def pack(
    task: Task,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    controller: Controller,
    progress: tuple[Memory, int],
) -> bytes:
    """Packs integration state (with warm start), commanded pose, statistics and step count."""
    memory, steps = progress
    state = np.zeros(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, data, state, _STATE)
    floats = np.concatenate(
        [
            state,
            controller.position,
            controller.quaternion,
            memory.source_origin,
            memory.target_origin,
            memory.source_half,
            memory.target_half,
            *memory.distractor_origins,
        ]
    ).astype("<f8")
    header = _HEADER.pack(
        _MAGIC,
        _digest(task),
        steps,
        memory.grasped_steps,
        len(floats),
        memory.ever_grasped,
        memory.consecutive_grasp,
        memory.ever_success,
    )
    return header + floats.tobytes()


def unpack(
    content: bytes,
    task: Task,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    controller: Controller,
) -> tuple[Memory, int]:
    """Sets the state of data and controller; returns the memory of the statistics and step count.

    The caller must update what depends on the state, such as contacts.
    """
    size = mujoco.mj_stateSize(model, _STATE)
    floats_count = size + 17 + 2 * len(task.distractors)
    expected = _HEADER.size + 8 * floats_count
    if len(content) != expected:
        raise InvalidSnapshot(f"snapshot: expected {expected} bytes, got {len(content)}")
    magic, digest, steps, grasped_steps, count, ever, consecutive, success = _HEADER.unpack_from(
        content
    )
    if magic != _MAGIC or digest != _digest(task) or count != floats_count:
        raise InvalidSnapshot(f"snapshot: expected one of task {task.id}, got another")
    floats = np.frombuffer(content, dtype="<f8", offset=_HEADER.size).astype(np.float64)
    if not np.isfinite(floats).all():
        raise InvalidSnapshot("snapshot: expected finite numbers, got NaN or infinity")
    state, rest = floats[:size], floats[size:]
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, state, _STATE)
    controller.position, controller.quaternion = rest[:3].copy(), rest[3:7].copy()
    memory = Memory(
        source_origin=rest[7:9].copy(),
        target_origin=rest[9:11].copy(),
        source_half=rest[11:14].copy(),
        target_half=rest[14:17].copy(),
        distractor_origins=tuple(rest[17:].reshape(-1, 2).copy()),
        grasped_steps=grasped_steps,
        ever_grasped=bool(ever),
        consecutive_grasp=bool(consecutive),
        ever_success=bool(success),
    )
    return memory, steps


def _digest(task: Task) -> bytes:
    identity = f"{task.name}/{task.variant}/{task.version}"
    return hashlib.sha256(identity.encode()).digest()[:16]
