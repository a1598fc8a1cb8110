"""World: one Bridge task in MuJoCo, with reset, step, save, restore and rendering."""

from dataclasses import dataclass
from types import TracebackType

import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env import expert, mjcf, snapshot
from rever_env.camera import Camera
from rever_env.controller import Controller, consecutive
from rever_env.fault import (
    Fault,
    InvalidAction,
    InvalidReset,
    PhysicsDiverged,
    RendererUnavailable,
)
from rever_env.layout import place
from rever_env.pose import in_base
from rever_env.protocol import Statistics
from rever_env.success import Judge, Memory
from rever_env.tasks import Layout, Pose, Task

__all__ = [
    "Fault",
    "InvalidAction",
    "InvalidReset",
    "Observation",
    "PhysicsDiverged",
    "RendererUnavailable",
    "Statistics",
    "Transition",
    "World",
]

_START_GAP = 0.002  # initial height of objects above their rest, metres
# m/s or rad/s: a larger speed means that the physics has diverged. An object that falls off the
# table and lands on an edge spins at more than 100 rad/s.
_SPEED_MAX = 1000.0
_DIVERGENCE = {
    int(warning): warning.name
    for warning in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
}
# MuJoCo's values for a kinematic tree that has just moved, and for one that is ready to sleep.
_AWAKE, _READY_TO_SLEEP = -(1 + mujoco.mjMINAWAKE), -1
# In Bridge the gripper's attitude is relative to pointing down: R_tcp times this, transposed.
DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Observation:
    """The input of a policy.

    image: uint8 (height, width, 3), RGB. state: float32 (8,) in Bridge's order: x y z (m) roll
    pitch yaw (rad) in the base frame, 0, gripper opening 0 to 1.
    """

    image: NDArray[np.uint8]
    state: NDArray[np.float32]
    instruction: str


@dataclass(frozen=True)
class Transition:
    """The result of one control step. Success does not terminate: SIMPLER judges the last step."""

    observation: Observation
    statistics: Statistics
    reward: float
    terminated: bool
    truncated: bool


class World:
    """One task in MuJoCo with its camera. Any thread may use it, one at a time."""

    def __init__(self, task: Task, image_height: int = 128, image_width: int = 128) -> None:
        silence_warnings()
        self.task = task
        self.model = mjcf.compile(task)
        assert self.model.opt.timestep == task.settings.timestep, "scene and tasks.toml disagree"
        self.data = mujoco.MjData(self.model)
        self.controller = Controller(self.model, task)
        self.judge = Judge(self.model, task)
        self.memory: Memory | None = None
        self.steps = 0
        self.camera = Camera(self.model, task.settings.camera, image_height, image_width)
        self._arm = consecutive([self.model.actuator(name).id for name in task.settings.arm_joints])
        ramp_steps = round(task.settings.ramp / task.settings.timestep)
        self._ramp = np.arange(1, ramp_steps + 1) / ramp_steps
        self._fingers = [self.model.actuator(name).id for name in task.settings.finger_joints]
        self._finger_positions = [
            self.model.joint(name).qposadr[0] for name in task.settings.finger_joints
        ]
        self._base = self.model.body(task.settings.robot_body).id
        self._tcp = self.model.site(task.settings.tcp).id
        self._finger_range = self.model.joint(task.settings.finger_joints[0]).range.copy()

    def reset(self, *, layout: int | None, seed: int) -> Observation:
        """Places and settles the objects; the same arguments give the same bytes."""
        placed = place(self.task, layout, seed)
        mujoco.mj_resetData(self.model, self.data)
        self.memory = None
        joints = np.array(self.task.robot_joints)
        self.data.qpos[: len(joints)] = joints
        self.data.ctrl[:] = joints
        place_objects(self.model, self.data, self.task, placed)
        self._settle()
        self.steps = 0
        self.controller.reset(self.data)
        self.memory = self.judge.begin(self.data)
        return self._observe()

    def step(self, action: NDArray[np.float64]) -> Transition:
        """Executes one control step of 0.2 s. action: float64 (7,), units as in BridgeEnv."""
        memory = self._running()
        if self.steps >= self.task.steps_max:
            raise InvalidAction(
                f"step {self.steps + 1}: expected at most {self.task.steps_max}; "
                "reset begins a new episode"
            )
        action = _checked(action)
        target = self.controller.joint_target(self.data, action)
        self._advance(target, float(action[6]))
        self.steps += 1
        statistics = self.judge.judge(self.data, memory)
        return Transition(
            observation=self._observe(),
            statistics=statistics,
            reward=1.0 if statistics.is_success else 0.0,
            terminated=False,
            truncated=self.steps >= self.task.steps_max,
        )

    def save(self) -> bytes:
        """The complete state of the episode, bit-exact."""
        return snapshot.pack(self.task, self.model, self.data, self.controller, self._memory_now())

    def restore(self, content: bytes) -> Observation:
        """Returns to a saved state of the same task."""
        self.memory, self.steps = snapshot.unpack(
            content, self.task, self.model, self.data, self.controller
        )
        self._forward()
        return self._observe()

    def expert_action(self) -> NDArray[np.float64]:
        """The scripted expert's action in this state, float64 (7,); changes nothing."""
        return self.expert_decision().action

    def expert_decision(self) -> expert.Decision:
        """The scripted expert's action with its subtask; changes nothing."""
        return expert.decide(self.task, expert.look(self))

    def close(self) -> None:
        self.camera.close()

    def __enter__(self) -> "World":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def running_memory(self) -> Memory:
        """The memory of the statistics; an error before the first reset."""
        return self._running()

    def gripper_opening(self) -> float:
        """Mean finger opening, 0 (closed) to 1 (open) of the joints' range."""
        low, high = (float(limit) for limit in self._finger_range)
        mean = sum(float(self.data.qpos[index]) for index in self._finger_positions) / 2.0
        return min(max((mean - low) / (high - low), 0.0), 1.0)

    def _memory_now(self) -> tuple[Memory, int]:
        return self._running(), self.steps

    def _running(self) -> Memory:
        if self.memory is None:
            raise InvalidAction("step, save or expert action before reset: expected a reset first")
        return self.memory

    def _settle(self) -> None:
        """Lets the objects come to rest as SIMPLER does, but without its drop before that."""
        settings = self.task.settings
        steps = round(settings.settle / settings.timestep)
        mujoco.mj_step(self.model, self.data, steps)
        self.data.qvel[:] = 0.0
        mujoco.mj_step(self.model, self.data, steps)
        moving = self.data.qvel[len(self.task.robot_joints) :].reshape(-1, 6)  # (objects, 6)
        speed = float(np.abs(moving[:, :3]).sum())
        spin = float(np.abs(moving[:, 3:]).sum())
        if speed > settings.settle_speed_max or spin > settings.settle_spin_max:
            mujoco.mj_step(self.model, self.data, round(settings.settle_extra / settings.timestep))
        self._refresh()

    def _advance(self, target: NDArray[np.float64], gripper: float) -> None:
        """Runs the physics of one control step; the arm's target moves linearly during the ramp."""
        settings = self.task.settings
        share = 0.5 * (min(max(gripper, -1.0), 1.0) + 1.0)
        opening = settings.gripper_closed + share * (
            settings.gripper_open - settings.gripper_closed
        )
        self.data.ctrl[self._fingers] = opening
        control = self.data.ctrl[self._arm]  # a view
        start = control.copy()
        for passed in np.multiply.outer(self._ramp, target - start) + start:
            control[:] = passed
            mujoco.mj_step(self.model, self.data)
        control[:] = target
        mujoco.mj_step(self.model, self.data, settings.substeps - len(self._ramp))
        self._refresh()

    def _forward(self) -> None:
        """Updates poses and contacts: after mj_step they are one physics step old.

        Wakes sleeping objects, because MuJoCo leaves out their contacts and the success rules need
        them; they sleep again after the next physics step. Which ones depends only on velocities,
        and the warm start is kept, so that continuing here equals continuing after a restore.
        """
        data = self.data
        warm_start = data.qacc_warmstart.copy()
        asleep = np.maximum.reduceat(np.abs(data.qvel), self.model.tree_dofadr) == 0.0  # (trees,)
        resting = asleep[self.model.dof_treeid]
        data.qvel[resting] = -0.0  # only wakes them
        mujoco.mj_forward(self.model, data)
        data.qvel[resting] = 0.0
        data.tree_asleep[:] = np.where(asleep, _READY_TO_SLEEP, _AWAKE)
        data.qacc_warmstart[:] = warm_start

    def _refresh(self) -> None:
        """Updates poses and contacts, and checks that the physics has not diverged."""
        self._forward()
        words = broken(self.model, self.data)
        if words:
            self.memory = None
            raise PhysicsDiverged(f"physics of {self.task.id} at step {self.steps}: {words}")

    def _observe(self) -> Observation:
        return Observation(
            image=self.camera.image(self.data),
            state=self._state(),
            instruction=self.task.instruction,
        )

    def _state(self) -> NDArray[np.float32]:
        data = self.data
        base, tcp = self._base, self._tcp
        pose = in_base(
            data.xpos[base], data.xmat[base], data.site_xpos[tcp], data.site_xmat[tcp], DOWN
        )
        return np.array([*pose, 0.0, self.gripper_opening()], np.float32)


def broken(model: mujoco.MjModel, data: mujoco.MjData) -> str:
    """Why the physics has diverged; empty if it has not."""
    speeds = np.abs(data.qvel)
    fastest = int(speeds.argmax())
    speed = float(speeds[fastest])
    warnings = divergence(data)
    if not warnings and speed <= _SPEED_MAX and np.isfinite(data.qpos).all():
        return ""
    return (
        f"expected finite speeds up to {_SPEED_MAX}, got {speed} of degree of freedom {fastest} of "
        f"joint {model.joint(model.dof_jntid[fastest]).name} with warnings {warnings}"
    )


def divergence(data: mujoco.MjData) -> list[str]:
    """MuJoCo's warnings of divergence since the last reset.

    MuJoCo then resets itself to the model's defaults, so that all numbers are finite again.
    """
    counts = data.warning.number
    return [name for index, name in _DIVERGENCE.items() if counts[index] > 0]


def place_objects(model: mujoco.MjModel, data: mujoco.MjData, task: Task, layout: Layout) -> None:
    """Places source, target and distractors above their resting positions."""
    source = Pose(layout.source_x, layout.source_y, layout.source_yaw)
    rows = [(task.source, source, task.source_height)]
    if task.target_height is not None:
        target = Pose(layout.target_x, layout.target_y, 0.0)
        rows.append((task.target, target, task.target_height))
    for distractor, pose in zip(task.distractors, layout.distractors, strict=True):
        rows.append((distractor.body, pose, distractor.height))
    for name, (x, y, yaw), height in rows:
        start = model.joint(name).qposadr[0]
        data.qpos[start : start + 3] = (x, y, height + _START_GAP)
        quaternion = np.zeros(4)
        mujoco.mju_axisAngle2Quat(quaternion, np.array([0.0, 0.0, 1.0]), np.deg2rad(yaw))
        data.qpos[start + 3 : start + 7] = quaternion


def silence_warnings() -> None:
    """Ignores MuJoCo's warnings; World reads their counters after each step.

    MuJoCo's own handler would append to a log file in the current folder.
    """
    mujoco.set_mju_user_warning(lambda _: None)


def _checked(action: NDArray[np.float64]) -> NDArray[np.float64]:
    array = np.asarray(action)
    if array.shape != (7,):
        raise InvalidAction(f"action: expected shape (7,), got {array.shape}")
    if array.dtype.kind not in "fiu":
        raise InvalidAction(f"action: expected numbers, got dtype {array.dtype}")
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise InvalidAction(f"action: expected finite numbers, got {array.tolist()}")
    return array
