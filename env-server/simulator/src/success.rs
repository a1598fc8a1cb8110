//! Success and the other episode statistics, following SIMPLER's evaluate().

use std::sync::Arc;

use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::fun::utility::{mju_mul_mat_t_vec, mju_rot_vec_quat};
use protocol::Statistics;

use crate::model::{Names, Vector};
use crate::tasks::Task;

/// The state of the statistics in an episode.
#[derive(Debug, Clone)]
pub struct Memory {
    /// The source's origin after settling: x and y in metres.
    source_origin: [f64; 2],
    target_origin: [f64; 2],
    distractor_origins: Vec<[f64; 2]>,
    /// Half extents after settling in metres, rotated as in SIMPLER.
    source_half: Vector,
    target_half: Vector,
    grasped_steps: u32,
    ever_grasped: bool,
    consecutive_grasp: bool,
    ever_success: bool,
}

/// The source's current contacts: the force of each finger in N, and what else it touches.
pub struct Touch {
    fingers: [Vector; 2],
    robot: bool,
    target: bool,
    elsewhere: bool,
}

/// Computes the statistics of an episode from contacts and poses.
pub struct Judge {
    task: Arc<Task>,
    names: Names,
    is_robot: Vec<bool>,
    cosine_min: f64,
}

impl Judge {
    pub fn new(model: &MjModel, names: &Names, task: &Arc<Task>) -> Judge {
        let parents = model.body_parentid();
        let is_robot = (0..parents.len()).map(|body| descends(parents, body, names.base));
        Judge {
            task: Arc::clone(task),
            names: names.clone(),
            is_robot: is_robot.collect(),
            cosine_min: task.grasp.angle_max.to_radians().cos(),
        }
    }

    /// The state at the start of an episode, after the objects have settled.
    pub fn begin(&self, data: &MjData<Arc<MjModel>>) -> Memory {
        let Names { source, target, .. } = self.names;
        let origin = |body: usize| [data.xpos()[body][0], data.xpos()[body][1]];
        Memory {
            source_origin: origin(source),
            target_origin: origin(target),
            distractor_origins: self.names.distractors.iter().map(|&body| origin(body)).collect(),
            source_half: half_extents(&data.xquat()[source], &self.task.rule.source_extents),
            target_half: half_extents(&data.xquat()[target], &self.task.rule.target_extents),
            grasped_steps: 0,
            ever_grasped: false,
            consecutive_grasp: false,
            ever_success: false,
        }
    }

    /// The statistics of this step; updates the state.
    pub fn judge(&self, data: &MjData<Arc<MjModel>>, memory: &mut Memory) -> Statistics {
        let rule = &self.task.grasp;
        let Names { source, target, .. } = self.names;
        let touch = self.touch(data);
        let is_grasped = self.is_grasped(data, &touch);
        memory.grasped_steps = if is_grasped { memory.grasped_steps + 1 } else { 0 };
        memory.ever_grasped |= is_grasped;
        memory.consecutive_grasp |= memory.grasped_steps >= rule.consecutive_steps;
        // SIMPLER compares the settled origin with the current centre of mass here. The offset
        // between the two is part of the source's displacement; this is kept.
        let source_moved = moved(&data.xipos()[source], &memory.source_origin);
        let distractors = self.names.distractors.iter().zip(&memory.distractor_origins);
        let other_moved = std::iter::once((&target, &memory.target_origin))
            .chain(distractors)
            .map(|(&body, origin)| moved(&data.xpos()[body], origin))
            .fold(0.0, f64::max);
        let on_target = self.is_on_target(data, memory, &touch);
        memory.ever_success |= on_target;
        Statistics {
            is_success: on_target,
            is_grasped,
            ever_grasped: memory.ever_grasped,
            consecutive_grasp: memory.consecutive_grasp,
            moved_correct_object: source_moved > rule.moved_min && source_moved > other_moved,
            moved_wrong_object: other_moved > rule.moved_min && other_moved > source_moved,
            source_on_target: on_target,
            ever_success: memory.ever_success,
            released_success: on_target && !touch.robot && (touch.target || touch.elsewhere),
        }
    }

    /// The source's contacts with a large enough impulse per physics step.
    pub fn touch(&self, data: &MjData<Arc<MjModel>>) -> Touch {
        let mut touch =
            Touch { fingers: [[0.0; 3]; 2], robot: false, target: false, elsewhere: false };
        let Names { source, target, .. } = self.names;
        let body_of_geom = data.model().geom_bodyid();
        for (index, contact) in data.contact().iter().enumerate() {
            let bodies = contact.geom.map(|geom| body_of_geom[geom as usize] as usize);
            if !bodies.contains(&source) || bodies[0] == bodies[1] {
                continue;
            }
            let wrench = data.contact_force(index);
            let local = [wrench[0], wrench[1], wrench[2]];
            if !self.counts(norm(&local)) {
                continue;
            }
            let other = if bodies[0] == source { bodies[1] } else { bodies[0] };
            if let Some(finger) = self.names.fingers.iter().position(|&body| body == other) {
                let mut force = [0.0; 3];
                mju_mul_mat_t_vec(&mut force, &contact.frame, &local);
                // The contact force acts on the second geom's body; it is negated if the source is
                // the first.
                let sign = if bodies[1] == source { 1.0 } else { -1.0 };
                for (sum, force) in touch.fingers[finger].iter_mut().zip(force) {
                    *sum += sign * force;
                }
            }
            touch.robot |= self.is_robot[other];
            touch.target |= other == target;
            touch.elsewhere |= other != target && !self.is_robot[other];
        }
        touch
    }

    /// Both fingers press the source within 60 degrees of their closing direction.
    pub fn is_grasped(&self, data: &MjData<Arc<MjModel>>, touch: &Touch) -> bool {
        let presses = |finger: usize, closing: f64| {
            let force = &touch.fingers[finger];
            let magnitude = norm(force);
            let axes = &data.xmat()[self.names.fingers[finger]];
            let along = closing * (axes[1] * force[0] + axes[4] * force[1] + axes[7] * force[2]);
            self.counts(magnitude) && along >= self.cosine_min * magnitude
        };
        presses(0, -1.0) && presses(1, 1.0)
    }

    /// SIMPLER's success: the source is above the target, near and low enough.
    pub fn is_on_target(
        &self,
        data: &MjData<Arc<MjModel>>,
        memory: &Memory,
        touch: &Touch,
    ) -> bool {
        let (source, target) = (&data.xipos()[self.names.source], &data.xipos()[self.names.target]);
        let offset: Vector = std::array::from_fn(|axis| source[axis] - target[axis]);
        let half = &memory.target_half;
        let near = norm(&offset[..2]) <= norm(&half[..2]) + self.task.grasp.target_margin;
        let gap = offset[2] - half[2] - memory.source_half[2];
        let above = offset[2] > 0.0 && gap <= self.task.rule.height_offset_max;
        let strays = self.task.rule.completely_on_target && touch.elsewhere;
        near && above && !strays
    }

    fn counts(&self, force: f64) -> bool {
        force * self.task.settings.timestep >= self.task.grasp.impulse_min
    }
}

/// SIMPLER rotates the full extents as a vector, including signs, and halves them; this is kept.
fn half_extents(quaternion: &[f64; 4], extents: &Vector) -> Vector {
    let mut rotated = [0.0; 3];
    mju_rot_vec_quat(&mut rotated, extents, quaternion);
    rotated.map(|extent| 0.5 * extent)
}

fn descends(parents: &[i32], mut body: usize, ancestor: usize) -> bool {
    while body != 0 {
        if body == ancestor {
            return true;
        }
        body = parents[body] as usize;
    }
    false
}

fn moved(position: &Vector, origin: &[f64; 2]) -> f64 {
    norm(&[position[0] - origin[0], position[1] - origin[1]])
}

/// Euclidean norm, summed in order so that it is the same in every language.
pub fn norm(vector: &[f64]) -> f64 {
    vector.iter().fold(0.0, |sum, value| sum + value * value).sqrt()
}
