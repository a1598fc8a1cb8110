"""The controller: end-effector delta target with inverse kinematics, as in SIMPLER."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from rever_env.tasks import Task

Vector = NDArray[np.float64]


class Controller:
    """Turns actions into joint targets; its state is the commanded pose of the tool centre point.

    Only MuJoCo's own functions and element-wise arithmetic are used, in a fixed order, so that
    another language linked to the same library computes the same bits.
    """

    def __init__(self, model: mujoco.MjModel, task: Task) -> None:
        self._model = model
        self._task = task
        self._scratch = mujoco.MjData(model)
        self._site = model.site(task.settings.tcp).id
        joints = [model.joint(name) for name in task.settings.arm_joints]
        self._positions = np.array([joint.qposadr[0] for joint in joints])
        self._dofs = np.array([joint.dofadr[0] for joint in joints])
        self._lower = np.array([joint.range[0] for joint in joints])
        self._upper = np.array([joint.range[1] for joint in joints])
        self._base = model.body(task.settings.robot_body).id
        # The commanded pose, world frame: position in metres, unit quaternion wxyz.
        self.position: Vector = np.zeros(3)
        self.quaternion: Vector = np.array([1.0, 0.0, 0.0, 0.0])

    def reset(self, data: mujoco.MjData) -> None:
        """The commanded pose starts at the measured one."""
        self.position, self.quaternion = self.measured(data)

    def measured(self, data: mujoco.MjData) -> tuple[Vector, Vector]:
        """Tool centre point now, world frame: position (3,) and quaternion wxyz (4,)."""
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.site_xmat[self._site])
        return data.site_xpos[self._site].copy(), quaternion

    def joint_target(self, data: mujoco.MjData, action: Vector) -> Vector:
        """Moves the commanded pose by the action and returns arm joint targets, (6,) rad.

        The translation is in the base frame; the rotation vector is too, about the current
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
        """Damped least squares from the measured joints; unreachable targets keep the measured."""
        settings = self._task.inverse_kinematics
        scratch = self._scratch
        scratch.qpos[:] = data.qpos
        jacobian = np.zeros((6, self._model.nv))
        gram = np.zeros((6, 6))
        solution = np.zeros(6)
        step = np.zeros(6)
        damping = settings.damping * settings.damping * np.eye(6)
        for _ in range(settings.iterations_max):
            residual = self._residual()
            if mujoco.mju_norm(residual) <= settings.tolerance:
                break
            mujoco.mj_comPos(self._model, scratch)
            mujoco.mj_jacSite(self._model, scratch, jacobian[:3], jacobian[3:], self._site)
            arm_jacobian = np.ascontiguousarray(jacobian[:, self._dofs])  # (6, 6)
            mujoco.mju_mulMatMatT(gram, arm_jacobian, arm_jacobian)
            gram += damping
            mujoco.mju_cholFactor(gram, 0.0)
            mujoco.mju_cholSolve(solution, gram, residual)
            mujoco.mju_mulMatTVec(step, arm_jacobian, solution)
            joints = scratch.qpos[self._positions] + step
            scratch.qpos[self._positions] = np.clip(joints, self._lower, self._upper)
        if mujoco.mju_norm(self._residual()) > settings.failure:
            scratch.qpos[:] = data.qpos
        joints = np.array(scratch.qpos[self._positions])
        return joints

    def _residual(self) -> Vector:
        """Commanded minus scratch pose, world frame: metres (3) and rotation vector in rad (3)."""
        scratch = self._scratch
        mujoco.mj_kinematics(self._model, scratch)
        residual = np.zeros(6)
        residual[:3] = self.position - scratch.site_xpos[self._site]
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, scratch.site_xmat[self._site])
        local = np.zeros(3)
        mujoco.mju_subQuat(local, self.quaternion, quaternion)
        mujoco.mju_rotVecQuat(residual[3:], local, quaternion)
        return residual
