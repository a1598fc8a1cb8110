"""End-effector delta controller with inverse kinematics, as in SIMPLER."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env.tasks import Task

Vector = NDArray[np.float64]


class Controller:
    """Turns actions into joint targets; its state is the commanded pose of the tool centre point.

    Only MuJoCo's functions and element-wise arithmetic in a fixed order are used, so that another
    language with the same library computes the same bits.
    """

    def __init__(self, model: mujoco.MjModel, task: Task) -> None:
        self._model = model
        self._task = task
        self._scratch = mujoco.MjData(model)
        self._site = model.site(task.settings.tcp).id
        joints = [model.joint(name) for name in task.settings.arm_joints]
        self._positions = consecutive([joint.qposadr[0] for joint in joints])
        self._dofs = consecutive([joint.dofadr[0] for joint in joints])
        self._lower = np.array([joint.range[0] for joint in joints])
        self._upper = np.array([joint.range[1] for joint in joints])
        self._base = model.body(task.settings.robot_body).id
        damping = task.inverse_kinematics.damping
        self._damping = damping * damping * np.eye(len(joints))
        # Allocated once: allocation costs more than filling. The first three are views.
        self._joints: Vector = self._scratch.qpos[self._positions]
        self._site_position = self._scratch.site_xpos[self._site]
        self._site_axes = self._scratch.site_xmat[self._site]
        self._residual = np.zeros(6)
        self._jacobian = np.zeros((6, model.nv))
        # The commanded pose, world frame: position in metres, unit quaternion wxyz.
        self.position: Vector = np.zeros(3)
        self.quaternion: Vector = np.array([1.0, 0.0, 0.0, 0.0])

    def reset(self, data: mujoco.MjData) -> None:
        """Sets the commanded pose to the measured pose."""
        self.position, self.quaternion = self.measured(data)

    def measured(self, data: mujoco.MjData) -> tuple[Vector, Vector]:
        """Measured tool centre point, world frame: position (3,) and quaternion wxyz (4,)."""
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.site_xmat[self._site])
        return data.site_xpos[self._site].copy(), quaternion

    def joint_target(self, data: mujoco.MjData, action: Vector) -> Vector:
        """Moves the commanded pose by the action and returns arm joint targets, (6,) rad.

        Translation and rotation vector are in the base frame; the rotation is about the measured
        tool centre point: p = p_now + dp + dR (p_commanded - p_now), R = dR R_commanded.
        """
        base_quaternion = data.xquat[self._base]
        translation = np.zeros(3)
        mujoco.mju_rotVecQuat(translation, action[:3], base_quaternion)
        rotation = np.zeros(3)
        mujoco.mju_rotVecQuat(rotation, action[3:6], base_quaternion)
        turn = np.array([1.0, 0.0, 0.0, 0.0])
        angle = float(mujoco.mju_normalize3(rotation))
        if angle > 0.0:
            mujoco.mju_axisAngle2Quat(turn, rotation, angle)
        now = data.site_xpos[self._site]
        arm = np.zeros(3)
        mujoco.mju_rotVecQuat(arm, self.position - now, turn)
        self.position = now + translation + arm
        quaternion = np.zeros(4)
        mujoco.mju_mulQuat(quaternion, turn, self.quaternion)
        mujoco.mju_normalize4(quaternion)
        self.quaternion = quaternion
        return self._solve(data)

    def _solve(self, data: mujoco.MjData) -> Vector:
        """Damped least squares from the measured joints; an unreachable target keeps those."""
        settings = self._task.inverse_kinematics
        scratch, joints, jacobian = self._scratch, self._joints, self._jacobian
        scratch.qpos[:] = data.qpos
        arm_jacobian = np.empty((6, len(joints)))
        gram = np.empty((6, 6))
        solution, step = np.empty(6), np.empty(len(joints))
        distance = self._miss()
        for _ in range(settings.iterations_max):
            if distance <= settings.tolerance:
                break
            mujoco.mj_comPos(self._model, scratch)
            mujoco.mj_jacSite(self._model, scratch, jacobian[:3], jacobian[3:], self._site)
            arm_jacobian[:] = jacobian[:, self._dofs]
            mujoco.mju_mulMatMatT(gram, arm_jacobian, arm_jacobian)
            gram += self._damping
            mujoco.mju_cholFactor(gram, 0.0)
            mujoco.mju_cholSolve(solution, gram, self._residual)
            mujoco.mju_mulMatTVec(step, arm_jacobian, solution)
            step += joints
            np.maximum(step, self._lower, out=step)
            np.minimum(step, self._upper, out=joints)
            distance = self._miss()
        if distance > settings.failure:
            scratch.qpos[:] = data.qpos
        found: Vector = joints.copy()
        return found

    def _miss(self) -> float:
        """Fills the residual and returns its norm: commanded minus scratch pose, world frame.

        Metres (3) and rotation vector in rad (3).
        """
        residual = self._residual
        mujoco.mj_kinematics(self._model, self._scratch)
        np.subtract(self.position, self._site_position, out=residual[:3])
        quaternion, local = np.empty(4), np.empty(3)
        mujoco.mju_mat2Quat(quaternion, self._site_axes)
        mujoco.mju_subQuat(local, self.quaternion, quaternion)
        mujoco.mju_rotVecQuat(residual[3:], local, quaternion)
        return float(mujoco.mju_norm(residual))


def consecutive(indices: list[int]) -> slice:
    """Consecutive indices as a slice: a slice gives a view where a list gives a copy."""
    first, end = int(indices[0]), int(indices[-1]) + 1
    assert indices == list(range(first, end)), f"expected {first} to {end - 1}, got {indices}"
    return slice(first, end)
