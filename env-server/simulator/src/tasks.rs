//! The tasks: reads assets/tasks.toml, the one description for every simulator.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use protocol::Dimension;
use serde::Deserialize;
use toml::Spanned;

/// Numbers of an action: translation in metres, rotation vector in radians, gripper +1 open or -1 closed.
pub const ACTION_LENGTH: usize = 7;
/// Numbers of a state, in Bridge's order: x y z roll pitch yaw pad gripper.
pub const STATE_LENGTH: usize = 8;

/// Where source and target start: metres in the world frame, yaw in degrees.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(from = "[f64; 5]")]
pub struct Layout {
    pub source_x: f64,
    pub source_y: f64,
    pub source_yaw: f64,
    pub target_x: f64,
    pub target_y: f64,
}

/// The box random layouts are drawn from, and what is kept out of it.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RandomRanges {
    pub source_x: [f64; 2],
    pub source_y: [f64; 2],
    pub source_yaw: [f64; 2],
    pub target_x: [f64; 2],
    pub target_y: [f64; 2],
    pub separation_min: f64,
    pub exclusion_radius: f64,
    pub exclusion_yaw: f64,
}

/// Physics and control settings shared by all tasks; units as in tasks.toml.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorldSettings {
    pub timestep: f64,
    pub substeps: usize,
    pub ramp: f64,
    pub gripper_closed: f64,
    pub gripper_open: f64,
    pub settle: f64,
    pub settle_extra: f64,
    pub settle_speed_max: f64,
    pub settle_spin_max: f64,
    pub camera: String,
    pub tcp: String,
    pub arm_joints: [String; 6],
    pub finger_joints: [String; 2],
    pub finger_bodies: [String; 2],
    pub robot_body: String,
}

/// Settings of the damped least squares solver.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InverseKinematics {
    pub damping: f64,
    pub iterations_max: usize,
    pub tolerance: f64,
    pub failure: f64,
}

/// SIMPLER's thresholds for grasped and moved.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GraspRule {
    pub impulse_min: f64,
    pub angle_max: f64,
    pub consecutive_steps: u32,
    pub moved_min: f64,
    pub target_margin: f64,
}

/// One task in one variant, complete: nothing else decides what an episode is.
#[derive(Debug, Clone)]
pub struct Task {
    pub name: String,
    pub scene: PathBuf,
    pub rule: TaskRule,
    pub state: Vec<Dimension>,
    pub action: Vec<Dimension>,
    pub settings: WorldSettings,
    pub inverse_kinematics: InverseKinematics,
    pub grasp: GraspRule,
}

/// What stands under a task's name.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskRule {
    pub variant: String,
    pub version: u32,
    /// Python's name for it; nobody asks for it here.
    #[serde(rename = "gymnasium_id")]
    pub _gymnasium_id: String,
    pub instruction: String,
    pub steps_max: u32,
    pub scene: String,
    pub robot_joints: [f64; 8],
    pub source: String,
    pub target: String,
    /// For reasoning about demonstrations, which only Python records.
    #[serde(rename = "source_phrase")]
    pub _source_phrase: String,
    #[serde(rename = "target_phrase")]
    pub _target_phrase: String,
    pub source_extents: [f64; 3],
    pub target_extents: [f64; 3],
    pub height_offset_max: f64,
    pub completely_on_target: bool,
    pub source_height: f64,
    /// None where the target does not move.
    pub target_height: Option<f64>,
    pub grasp_offset: [f64; 3],
    pub grasp_symmetry: f64,
    pub source_bottom: f64,
    pub target_top: f64,
    pub hover: f64,
    pub release_gap: f64,
    pub random: RandomRanges,
    pub grid: Grid,
}

/// The fixed layouts.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    pub layouts: Vec<Layout>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    state: [Bounds; STATE_LENGTH],
    action: [Bounds; ACTION_LENGTH],
    world: WorldSettings,
    inverse_kinematics: InverseKinematics,
    grasp: GraspRule,
    tasks: BTreeMap<String, Spanned<TaskRule>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Bounds {
    name: String,
    low: f32,
    high: f32,
}

impl WorldSettings {
    /// Control steps per second of simulated time.
    pub fn control_hz(&self) -> f64 {
        1.0 / (self.timestep * self.substeps as f64)
    }
}

impl From<Bounds> for Dimension {
    fn from(Bounds { name, low, high }: Bounds) -> Dimension {
        Dimension { name, low: Some(low), high: Some(high), discrete: false }
    }
}

impl From<[f64; 5]> for Layout {
    fn from([source_x, source_y, source_yaw, target_x, target_y]: [f64; 5]) -> Layout {
        Layout { source_x, source_y, source_yaw, target_x, target_y }
    }
}

/// All tasks of a folder with tasks.toml and scenes, in the file's order; unknown or missing keys are errors.
pub fn load(assets: &Path) -> Result<Vec<Task>> {
    let path = assets.join("tasks.toml");
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("cannot read {}", path.display()))?;
    let file: File =
        toml::from_str(&text).with_context(|| format!("cannot read {}", path.display()))?;
    let File { state, action, world, inverse_kinematics, grasp, tasks } = file;
    let (state, action) = (state.map(Dimension::from), action.map(Dimension::from));
    let mut tasks: Vec<(String, Spanned<TaskRule>)> = tasks.into_iter().collect();
    tasks.sort_by_key(|(_, rule)| rule.span().start);
    let task = |(name, rule): (String, Spanned<TaskRule>)| {
        let rule = rule.into_inner();
        Task {
            name,
            scene: assets.join(&rule.scene),
            rule,
            state: state.to_vec(),
            action: action.to_vec(),
            settings: world.clone(),
            inverse_kinematics: inverse_kinematics.clone(),
            grasp: grasp.clone(),
        }
    };
    Ok(tasks.into_iter().map(task).collect())
}
