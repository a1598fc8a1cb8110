//! The simulated environment of one task: reset, step, save, restore, render.

use std::sync::{Arc, Once};

use mujoco_rs::mujoco_c::{mjMINAWAKE, mju_user_warning};
use mujoco_rs::prelude::*;
use mujoco_rs::wrappers::fun::utility::*;
use protocol::{Observation, Statistics, Transition};

use crate::camera::Camera;
use crate::controller::{ARM_JOINTS, Controller, Pose};
use crate::expert::{self, Sight};
use crate::fault::Fault;
use crate::layout::place;
use crate::model::{self, Names, Vector};
use crate::success::{Judge, Memory};
use crate::tasks::{ACTION_LENGTH, Layout, STATE_LENGTH, Task};

/// Objects start this far above their rest height, in metres.
const START_GAP: f64 = 0.002;
/// Maximum speed in m/s or rad/s; beyond it the physics has diverged. An object that falls off the
/// table and lands on an edge spins at more than 100 rad/s.
const SPEED_MAX: f64 = 1000.0;
/// MuJoCo's values for a kinematic tree that has just moved and for one that may sleep.
const AWAKE: i32 = -1 - mjMINAWAKE as i32;
const READY_TO_SLEEP: i32 = -1;
/// Bridge's gripper attitude is relative to pointing down: R_tcp times the transpose of this.
const DOWN: [f64; 9] = [0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0];
/// The complete input of the next physics step, including the warm start.
const STATE: u32 = MjtState::mjSTATE_INTEGRATION as u32;
const WARNINGS: [(MjtWarning, &str); 3] = [
    (MjtWarning::mjWARN_BADQPOS, "mjWARN_BADQPOS"),
    (MjtWarning::mjWARN_BADQVEL, "mjWARN_BADQVEL"),
    (MjtWarning::mjWARN_BADQACC, "mjWARN_BADQACC"),
];

/// One task in MuJoCo with its camera. Use it only in the thread that created it.
pub struct World {
    task: Arc<Task>,
    names: Names,
    data: MjData<Arc<MjModel>>,
    controller: Controller,
    judge: Judge,
    camera: Camera,
    episode: Option<Episode>,
}

#[derive(Debug, Clone)]
struct Episode {
    memory: Memory,
    steps: u32,
}

/// The complete state of an episode, bit-exact.
#[derive(Debug, Clone)]
pub struct Snapshot {
    state: Box<[f64]>,
    commanded: Pose,
    episode: Episode,
}

impl World {
    pub fn new(task: &Arc<Task>, image_height: u32, image_width: u32) -> Result<World, Fault> {
        silence_warnings();
        let (model, names) = model::compile(task)?;
        let camera = Camera::new(&model, names.camera, image_height, image_width)?;
        Ok(World {
            controller: Controller::new(&model, &names, task),
            judge: Judge::new(&model, &names, task),
            camera,
            data: MjData::new(model),
            task: Arc::clone(task),
            names,
            episode: None,
        })
    }

    /// Places the objects and lets them settle. The same arguments give the same bytes.
    pub fn reset(&mut self, layout: Option<u32>, seed: u64) -> Result<Observation, Fault> {
        let layout = place(&self.task, layout, seed)?;
        self.data.reset();
        self.episode = None;
        let joints = self.task.rule.robot_joints;
        self.data.qpos_mut()[..joints.len()].copy_from_slice(&joints);
        self.data.ctrl_mut().copy_from_slice(&joints);
        self.place_objects(&layout);
        self.settle()?;
        self.controller.reset(&self.data);
        self.episode = Some(Episode { memory: self.judge.begin(&self.data), steps: 0 });
        self.observe()
    }

    /// Executes one control step of 0.2 s. Success does not end an episode, because SIMPLER
    /// evaluates the last step.
    pub fn step(&mut self, action: &[f32]) -> Result<Transition, Fault> {
        let steps = self.running()?.steps;
        let steps_max = self.task.rule.steps_max;
        if steps >= steps_max {
            return Err(Fault::Wrong(format!(
                "step {}: expected at most {steps_max}; reset begins a new episode",
                steps + 1
            )));
        }
        let action: [f32; ACTION_LENGTH] = action.try_into().map_err(|_| {
            let (expected, got) = (ACTION_LENGTH, action.len());
            Fault::Wrong(format!("action: expected shape ({expected},), got ({got},)"))
        })?;
        let action = action.map(f64::from);
        let target = self.controller.joint_target(&self.data, &action);
        self.advance(&target, action[6])?;
        let statistics = self.judged()?;
        Ok(Transition {
            observation: self.observe()?,
            statistics,
            reward: if statistics.is_success { 1.0 } else { 0.0 },
            terminated: false,
            truncated: steps + 1 >= steps_max,
        })
    }

    pub fn save(&self) -> Result<Snapshot, Fault> {
        let episode = self.running()?.clone();
        Ok(Snapshot {
            state: self.data.state(STATE),
            commanded: self.controller.commanded,
            episode,
        })
    }

    /// Restores a saved state of the same task.
    pub fn restore(&mut self, snapshot: &Snapshot) -> Result<Observation, Fault> {
        self.data.reset();
        // SAFETY: `eq_active` is not read before the next forward pass.
        unsafe { self.data.set_state(&snapshot.state, STATE) }
            .map_err(|error| Fault::Internal(error.to_string()))?;
        self.forward();
        self.controller.commanded = snapshot.commanded;
        self.episode = Some(snapshot.episode.clone());
        self.observe()
    }

    /// The scripted expert's noise-free action in this state; changes nothing.
    pub fn expert_action(&self) -> Result<[f32; ACTION_LENGTH], Fault> {
        let sight = self.sight(&self.running()?.memory);
        Ok(expert::decide(&self.task.rule, &sight).map(|number| number as f32))
    }

    /// Number of steps in this episode.
    pub fn steps(&self) -> Result<u32, Fault> {
        Ok(self.running()?.steps)
    }

    /// Joint positions and velocities, to compare simulators.
    pub fn joints(&self) -> (&[f64], &[f64]) {
        (self.data.qpos(), self.data.qvel())
    }

    fn sight(&self, memory: &Memory) -> Sight {
        let (data, names) = (&self.data, &self.names);
        let touch = self.judge.touch(data);
        let source_axes = &data.xmat()[names.source];
        let finger_axes = &data.site_xmat()[names.tcp];
        let fingers = self.fingers();
        Sight {
            tcp: data.site_xpos()[names.tcp],
            finger_angle: finger_axes[4].atan2(finger_axes[1]),
            finger_opening: (fingers[0] + fingers[1]) / 2.0,
            source: data.xpos()[names.source],
            source_centre: data.xipos()[names.source],
            source_angle: source_axes[3].atan2(source_axes[0]),
            target_centre: data.xipos()[names.target],
            target_origin: data.xpos()[names.target],
            held: self.judge.is_grasped(data, &touch),
            on_target: self.judge.is_on_target(data, memory, &touch),
            world_from_base: data.xmat()[names.base],
        }
    }

    fn running(&self) -> Result<&Episode, Fault> {
        self.episode.as_ref().ok_or_else(|| {
            Fault::Wrong(
                "step, save or expert action before reset: expected a reset first".to_owned(),
            )
        })
    }

    /// Counts the step and computes its statistics.
    fn judged(&mut self) -> Result<Statistics, Fault> {
        let Some(episode) = &mut self.episode else {
            return Err(Fault::Internal("step without an episode".to_owned()));
        };
        episode.steps += 1;
        Ok(self.judge.judge(&self.data, &mut episode.memory))
    }

    fn place_objects(&mut self, layout: &Layout) {
        let rule = &self.task.rule;
        let source = [layout.source_x, layout.source_y, rule.source_height];
        let mut rows = vec![(self.names.source_joint, source, layout.source_yaw)];
        if let (Some(joint), Some(height)) = (self.names.target_joint, rule.target_height) {
            rows.push((joint, [layout.target_x, layout.target_y, height], 0.0));
        }
        let distractors = self.names.distractor_joints.iter().zip(&rule.distractors);
        for ((&joint, distractor), pose) in distractors.zip(&layout.distractors) {
            rows.push((joint, [pose.x, pose.y, distractor.height], pose.yaw));
        }
        for (joint, [x, y, height], yaw) in rows {
            let start = self.data.model().jnt_qposadr()[joint] as usize;
            let mut quaternion = [0.0; 4];
            mju_axis_angle_2_quat(&mut quaternion, &[0.0, 0.0, 1.0], yaw.to_radians());
            let pose = &mut self.data.qpos_mut()[start..start + 7];
            pose[..3].copy_from_slice(&[x, y, height + START_GAP]);
            pose[3..].copy_from_slice(&quaternion);
        }
    }

    /// Lets the objects come to rest, as in SIMPLER, but without its initial drop.
    fn settle(&mut self) -> Result<(), Fault> {
        let task = Arc::clone(&self.task);
        let settings = &task.settings;
        let count = |seconds: f64| (seconds / settings.timestep).round_ties_even() as usize;
        self.run(count(settings.settle));
        self.data.qvel_mut().fill(0.0);
        self.run(count(settings.settle));
        let moving = &self.data.qvel()[task.rule.robot_joints.len()..];
        let sum = |part: std::ops::Range<usize>| {
            let parts = moving.chunks_exact(6).flat_map(|object| &object[part.clone()]);
            parts.fold(0.0, |sum, speed| sum + speed.abs())
        };
        if sum(0..3) > settings.settle_speed_max || sum(3..6) > settings.settle_spin_max {
            self.run(count(settings.settle_extra));
        }
        self.refresh(0)
    }

    /// Runs the physics of one control step; the arm's target moves linearly during the ramp.
    fn advance(&mut self, target: &[f64; ARM_JOINTS], gripper: f64) -> Result<(), Fault> {
        let task = Arc::clone(&self.task);
        let settings = &task.settings;
        let share = 0.5 * (gripper.clamp(-1.0, 1.0) + 1.0);
        let opening =
            settings.gripper_closed + share * (settings.gripper_open - settings.gripper_closed);
        for actuator in self.names.finger_actuators {
            self.data.ctrl_mut()[actuator] = opening;
        }
        let start = self.names.arm_actuators.map(|actuator| self.data.ctrl()[actuator]);
        let ramp_steps = (settings.ramp / settings.timestep).round_ties_even() as usize;
        for index in 1..=ramp_steps {
            let share = index as f64 / ramp_steps as f64;
            self.command(&std::array::from_fn(|joint| {
                start[joint] + (target[joint] - start[joint]) * share
            }));
            self.data.step();
        }
        self.command(target);
        self.run(settings.substeps - ramp_steps);
        self.refresh(self.running()?.steps)
    }

    fn command(&mut self, joints: &[f64; ARM_JOINTS]) {
        for (actuator, joint) in self.names.arm_actuators.into_iter().zip(joints) {
            self.data.ctrl_mut()[actuator] = *joint;
        }
    }

    fn run(&mut self, physics_steps: usize) {
        (0..physics_steps).for_each(|_| self.data.step());
    }

    /// Updates poses and contacts: after a physics step they are one step old.
    ///
    /// Sleeping objects are woken, because MuJoCo omits their contacts and the success check needs
    /// them; they sleep again after the next physics step. Which objects sleep depends only on the
    /// velocities, and the warm start is kept, so that continuing from here equals continuing after
    /// a restore.
    fn forward(&mut self) {
        let warm_start = self.data.qacc_warmstart().to_vec();
        let model = self.data.model();
        let mut marks = vec![READY_TO_SLEEP; model.tree_dofadr().len()];
        for (speed, &tree) in self.data.qvel().iter().zip(model.dof_treeid()) {
            if *speed != 0.0 {
                marks[tree as usize] = AWAKE;
            }
        }
        let trees = model.dof_treeid().iter().enumerate();
        let resting = trees.filter(|(_, tree)| marks[**tree as usize] == READY_TO_SLEEP);
        let resting: Vec<usize> = resting.map(|(dof, _)| dof).collect();
        for &dof in &resting {
            self.data.qvel_mut()[dof] = -0.0; // wakes them in MuJoCo without any other effect
        }
        self.data.forward();
        for &dof in &resting {
            self.data.qvel_mut()[dof] = 0.0;
        }
        // SAFETY: no mark is an index; MuJoCo counts such marks up to -1.
        unsafe { self.data.tree_asleep_mut() }.copy_from_slice(&marks);
        self.data.qacc_warmstart_mut().copy_from_slice(&warm_start);
    }

    /// Updates poses and contacts and checks that the physics has not diverged.
    fn refresh(&mut self, steps: u32) -> Result<(), Fault> {
        self.forward();
        let warned = WARNINGS
            .into_iter()
            .filter(|(warning, _)| self.data.warning()[*warning as usize].number > 0);
        let diverged: Vec<String> = warned.map(|(_, name)| format!("'{name}'")).collect();
        let speeds = self.data.qvel().iter().map(|speed| speed.abs());
        // The first NaN, or the first of the fastest.
        let (fastest, speed) = speeds.enumerate().fold((0, f64::NEG_INFINITY), |best, next| {
            if best.1.is_nan() || next.1 <= best.1 { best } else { next }
        });
        let finite = self.data.qpos().iter().all(|position| position.is_finite());
        if diverged.is_empty() && finite && speed <= SPEED_MAX {
            return Ok(());
        }
        self.episode = None;
        let model = self.data.model();
        let joint = model.dof_jntid()[fastest] as usize;
        let joint = model.id_to_name(MjtObj::mjOBJ_JOINT, joint).unwrap_or_default();
        Err(Fault::PhysicsDiverged(format!(
            "physics of {} at step {steps}: expected finite speeds up to {SPEED_MAX:?}, got \
             {speed:?} of degree of freedom {fastest} of joint {joint} with warnings [{}]",
            self.task.id,
            diverged.join(", ")
        )))
    }

    fn observe(&mut self) -> Result<Observation, Fault> {
        Ok(Observation {
            image: self.camera.image(&mut self.data)?,
            state: self.state().to_vec(),
            instruction: self.task.rule.instruction.clone(),
            expert_action: None,
        })
    }

    fn state(&self) -> [f32; STATE_LENGTH] {
        let (data, names) = (&self.data, &self.names);
        let base = &data.xmat()[names.base];
        let (tcp, origin) = (&data.site_xpos()[names.tcp], &data.xpos()[names.base]);
        let from_base: Vector = std::array::from_fn(|axis| tcp[axis] - origin[axis]);
        let mut position = [0.0; 3];
        mju_mul_mat_t_vec(&mut position, base, &from_base);
        let (mut in_base, mut attitude) = ([0.0; 9], [0.0; 9]);
        mju_mul_mat_t_mat(&mut in_base, base, &data.site_xmat()[names.tcp], 3, 3, 3);
        mju_mul_mat_mat_t(&mut attitude, &in_base, &DOWN, 3, 3, 3);
        let [xx, _, _, yx, _, _, zx, zy, zz] = attitude;
        let roll = zy.atan2(zz);
        let pitch = (-zx).atan2((zy * zy + zz * zz).sqrt());
        let yaw = yx.atan2(xx);
        let [x, y, z] = position;
        [x, y, z, roll, pitch, yaw, 0.0, self.gripper_opening()].map(|number| number as f32)
    }

    /// Mean finger opening, from 0 (closed) to 1 (open) of the joints' range.
    fn gripper_opening(&self) -> f64 {
        let [low, high] = self.data.model().jnt_range()[self.names.finger_joints[0]];
        let fingers = self.fingers();
        let mean = (fingers[0] + fingers[1]) / 2.0;
        ((mean - low) / (high - low)).clamp(0.0, 1.0)
    }

    fn fingers(&self) -> [f64; 2] {
        let starts = self.data.model().jnt_qposadr();
        self.names.finger_joints.map(|joint| self.data.qpos()[starts[joint] as usize])
    }
}

/// The warning counters are read after each step. MuJoCo's own handler would also write a log file
/// into the current working folder.
fn silence_warnings() {
    static SILENCED: Once = Once::new();
    unsafe extern "C" fn ignore(_warning: *const std::ffi::c_char) {}
    // SAFETY: set once, before any environment of this process is stepped.
    SILENCED.call_once(|| unsafe { mju_user_warning = Some(ignore) });
}
