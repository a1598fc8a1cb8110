//! The controller: end-effector delta targets with inverse kinematics, as in SIMPLER.
//!
//! It uses only MuJoCo's functions and element-wise arithmetic in the same order as the Python
//! server, so that both compute the same bits.

use std::sync::Arc;

use mujoco_rs::mujoco_c::{mju_cholFactor, mju_cholSolve};
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::fun::utility::*;

use crate::model::{Names, Vector};
use crate::tasks::{InverseKinematics, Task};

/// Number of arm joints.
pub const ARM_JOINTS: usize = 6;

/// Converts actions to joint targets; its state is the commanded pose of the tool centre point
/// (TCP).
pub struct Controller {
    scratch: MjData<Arc<MjModel>>,
    settings: InverseKinematics,
    site: usize,
    base: usize,
    positions: [usize; ARM_JOINTS],
    dofs: [usize; ARM_JOINTS],
    ranges: [[f64; 2]; ARM_JOINTS],
    pub commanded: Pose,
}

/// In the world frame: position in metres, unit quaternion wxyz.
#[derive(Debug, Clone, Copy)]
pub struct Pose {
    pub position: Vector,
    pub quaternion: [f64; 4],
}

impl Controller {
    pub fn new(model: &Arc<MjModel>, names: &Names, task: &Task) -> Controller {
        let joints = names.arm;
        Controller {
            scratch: MjData::new(Arc::clone(model)),
            settings: task.inverse_kinematics.clone(),
            site: names.tcp,
            base: names.base,
            positions: joints.map(|joint| model.jnt_qposadr()[joint] as usize),
            dofs: joints.map(|joint| model.jnt_dofadr()[joint] as usize),
            ranges: joints.map(|joint| model.jnt_range()[joint]),
            commanded: Pose { position: [0.0; 3], quaternion: [1.0, 0.0, 0.0, 0.0] },
        }
    }

    /// Sets the commanded pose to the measured one.
    pub fn reset(&mut self, data: &MjData<Arc<MjModel>>) {
        let mut quaternion = [0.0; 4];
        mju_mat_2_quat(&mut quaternion, &data.site_xmat()[self.site]);
        self.commanded = Pose { position: data.site_xpos()[self.site], quaternion };
    }

    /// Moves the commanded pose by the action and returns arm joint targets in rad.
    ///
    /// Translation and rotation vector are in the base frame; the rotation is about the current
    /// tool centre point: p = p_now + dp + dR (p_commanded - p_now), R = dR R_commanded.
    pub fn joint_target(
        &mut self,
        data: &MjData<Arc<MjModel>>,
        action: &[f64; 7],
    ) -> [f64; ARM_JOINTS] {
        let [x, y, z, rotation_x, rotation_y, rotation_z, _] = *action;
        let base = &data.xquat()[self.base];
        let mut translation = [0.0; 3];
        mju_rot_vec_quat(&mut translation, &[x, y, z], base);
        let mut rotation = [0.0; 3];
        mju_rot_vec_quat(&mut rotation, &[rotation_x, rotation_y, rotation_z], base);
        let mut turn = [1.0, 0.0, 0.0, 0.0];
        let angle = mju_normalize_3(&mut rotation);
        if angle > 0.0 {
            mju_axis_angle_2_quat(&mut turn, &rotation, angle);
        }
        let now = data.site_xpos()[self.site];
        let from_now = std::array::from_fn(|axis| self.commanded.position[axis] - now[axis]);
        let mut arm = [0.0; 3];
        mju_rot_vec_quat(&mut arm, &from_now, &turn);
        let position = std::array::from_fn(|axis| now[axis] + translation[axis] + arm[axis]);
        let mut quaternion = [0.0; 4];
        mju_mul_quat(&mut quaternion, &turn, &self.commanded.quaternion);
        mju_normalize_4(&mut quaternion);
        self.commanded = Pose { position, quaternion };
        self.solve(data)
    }

    /// Damped least squares from the measured joints; for an unreachable target the joints stay as
    /// measured.
    fn solve(&mut self, data: &MjData<Arc<MjModel>>) -> [f64; ARM_JOINTS] {
        self.scratch.qpos_mut().copy_from_slice(data.qpos());
        let damping = self.settings.damping * self.settings.damping;
        for _ in 0..self.settings.iterations_max {
            let residual = self.residual();
            if mju_norm(&residual) <= self.settings.tolerance {
                break;
            }
            let jacobian = self.jacobian();
            let mut gram = [0.0; ARM_JOINTS * ARM_JOINTS];
            mju_mul_mat_mat_t(&mut gram, &jacobian, &jacobian, 6, 6, 6);
            (0..6).for_each(|index| gram[7 * index] += damping);
            let mut solution = [0.0; 6];
            // SAFETY: a matrix of 6 x 6 and vectors of 6.
            unsafe {
                mju_cholFactor(gram.as_mut_ptr(), 6, 0.0);
                mju_cholSolve(solution.as_mut_ptr(), gram.as_ptr(), residual.as_ptr(), 6);
            }
            let mut step = [0.0; ARM_JOINTS];
            mju_mul_mat_t_vec(&mut step, &jacobian, &solution);
            let joints = self.scratch.qpos_mut();
            for (index, &position) in self.positions.iter().enumerate() {
                let [low, high] = self.ranges[index];
                joints[position] = (joints[position] + step[index]).max(low).min(high);
            }
        }
        if mju_norm(&self.residual()) > self.settings.failure {
            self.scratch.qpos_mut().copy_from_slice(data.qpos());
        }
        self.positions.map(|position| self.scratch.qpos()[position])
    }

    /// Jacobian of the tool centre point with respect to the arm joints: three rows of translation,
    /// three of rotation.
    fn jacobian(&mut self) -> [f64; 6 * ARM_JOINTS] {
        self.scratch.com_pos();
        let (translation, rotation) = self.scratch.jac_site(true, true, self.site);
        let width = translation.len() / 3;
        let mut jacobian = [0.0; 6 * ARM_JOINTS];
        for row in 0..3 {
            for (column, &dof) in self.dofs.iter().enumerate() {
                jacobian[row * ARM_JOINTS + column] = translation[row * width + dof];
                jacobian[(row + 3) * ARM_JOINTS + column] = rotation[row * width + dof];
            }
        }
        jacobian
    }

    /// Commanded minus scratch pose in the world frame: metres (3) and rotation vector in rad (3).
    fn residual(&mut self) -> [f64; 6] {
        self.scratch.kinematics();
        let now = self.scratch.site_xpos()[self.site];
        let mut quaternion = [0.0; 4];
        mju_mat_2_quat(&mut quaternion, &self.scratch.site_xmat()[self.site]);
        let mut local = [0.0; 3];
        mju_sub_quat(&mut local, &self.commanded.quaternion, &quaternion);
        let mut turn = [0.0; 3];
        mju_rot_vec_quat(&mut turn, &local, &quaternion);
        std::array::from_fn(|index| match index {
            0..3 => self.commanded.position[index] - now[index],
            _ => turn[index - 3],
        })
    }
}
