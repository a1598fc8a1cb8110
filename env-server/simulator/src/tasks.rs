//! The tasks and their variants, read from assets/tasks.toml, which all simulators share.

use std::collections::BTreeMap;
use std::fmt;

use anyhow::{Context, Result, bail, ensure};
use protocol::Dimension;
use serde::Deserialize;
use toml::{Table, Value};

use crate::assets::Assets;

/// Dimensions of an action: translation in metres, rotation vector in radians, gripper +1 open or
/// -1 closed.
pub const ACTION_LENGTH: usize = 7;
/// Dimensions of a state in Bridge's order: x y z roll pitch yaw pad gripper.
pub const STATE_LENGTH: usize = 8;

const FILE: &str = "tasks.toml";

/// The variant of a task that is defined by the task's own table.
pub const DEFAULT: &str = "default";
/// Stands for all variants or all tasks.
const ALL: &str = "all";

/// A task in one of its variants. Its text is TASK, or TASK/VARIANT for a variant other than the
/// default.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskId {
    pub task: String,
    pub variant: String,
}

/// The initial positions of the objects: metres in the world frame, yaw in degrees.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(from = "[f64; 5]")]
pub struct Layout {
    pub source_x: f64,
    pub source_y: f64,
    pub source_yaw: f64,
    pub target_x: f64,
    pub target_y: f64,
    pub distractors: Vec<Pose>,
}

/// The initial position of a distractor: metres in the world frame, yaw in degrees.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(from = "[f64; 3]")]
pub struct Pose {
    pub x: f64,
    pub y: f64,
    pub yaw: f64,
}

/// An object that is not part of the task: a body of the scene with a free joint of the same name.
///
/// `x`, `y` and `yaw` are the ranges of random layouts, in which it keeps `separation_min` from
/// every other object.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Distractor {
    pub body: String,
    pub height: f64,
    pub x: [f64; 2],
    pub y: [f64; 2],
    pub yaw: [f64; 2],
    pub separation_min: f64,
    /// One pose for each layout of the grid.
    pub layouts: Vec<Pose>,
}

/// A task's changes to its scene before it is compiled: element, its name, attribute, value.
pub type MjcfChanges = BTreeMap<String, BTreeMap<String, BTreeMap<String, String>>>;

/// The ranges of random layouts and the exclusions around grid layouts.
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

/// Settings of the damped least-squares solver.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InverseKinematics {
    pub damping: f64,
    pub iterations_max: usize,
    pub tolerance: f64,
    pub failure: f64,
}

/// SIMPLER's thresholds for grasping and moving.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GraspRule {
    pub impulse_min: f64,
    pub angle_max: f64,
    pub consecutive_steps: u32,
    pub moved_min: f64,
    pub target_margin: f64,
}

/// One task in one variant; it completely defines an episode.
#[derive(Debug, Clone)]
pub struct Task {
    pub id: TaskId,
    pub assets: Assets,
    pub rule: TaskRule,
    pub state: Vec<Dimension>,
    pub action: Vec<Dimension>,
    pub settings: WorldSettings,
    pub inverse_kinematics: InverseKinematics,
    pub grasp: GraspRule,
}

/// The table of a task, with a variant's values merged in.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskRule {
    pub version: u32,
    /// The task's Gymnasium id, which only Python uses.
    #[serde(rename = "gymnasium_id")]
    pub _gymnasium_id: String,
    pub instruction: String,
    pub steps_max: u32,
    pub scene: String,
    #[serde(default)]
    pub mjcf: MjcfChanges,
    pub robot_joints: [f64; 8],
    pub source: String,
    pub target: String,
    /// Phrases in the reasoning of demonstrations, which only Python records.
    #[serde(rename = "source_phrase")]
    pub _source_phrase: String,
    #[serde(rename = "target_phrase")]
    pub _target_phrase: String,
    pub source_extents: [f64; 3],
    pub target_extents: [f64; 3],
    pub height_offset_max: f64,
    pub completely_on_target: bool,
    pub source_height: f64,
    /// `None` if the target does not move.
    pub target_height: Option<f64>,
    pub grasp_offset: [f64; 3],
    pub grasp_symmetry: f64,
    pub source_bottom: f64,
    pub target_top: f64,
    pub hover: f64,
    pub release_gap: f64,
    #[serde(default)]
    pub distractors: Vec<Distractor>,
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
    tasks: Table,
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
        Layout { source_x, source_y, source_yaw, target_x, target_y, distractors: Vec::new() }
    }
}

impl From<[f64; 3]> for Pose {
    fn from([x, y, yaw]: [f64; 3]) -> Pose {
        Pose { x, y, yaw }
    }
}

impl TaskId {
    /// Parses TASK or TASK/VARIANT.
    pub fn parse(text: &str) -> TaskId {
        let (task, variant) = text.rsplit_once('/').unwrap_or((text, DEFAULT));
        TaskId { task: task.to_owned(), variant: variant.to_owned() }
    }
}

impl fmt::Display for TaskId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.task)?;
        if self.variant != DEFAULT {
            write!(formatter, "/{}", self.variant)?;
        }
        Ok(())
    }
}

/// All tasks of tasks.toml in all variants, in the file's order. Unknown or missing keys are
/// errors.
pub fn load(assets: &Assets) -> Result<Vec<Task>> {
    read(&assets.text(FILE)?, assets).with_context(|| format!("cannot read {FILE}"))
}

/// The named tasks in the file's order: TASK, TASK/VARIANT, TASK/all, or all.
pub fn choose(tasks: Vec<Task>, names: &[String]) -> Result<Vec<Task>> {
    let matches = |name: &str, task: &Task| {
        let wanted = TaskId::parse(if name == ALL { "all/all" } else { name });
        [(&wanted.task, &task.id.task), (&wanted.variant, &task.id.variant)]
            .into_iter()
            .all(|(wanted, got)| wanted == ALL || wanted == got)
    };
    for name in names {
        if !tasks.iter().any(|task| matches(name, task)) {
            let known: Vec<String> = tasks.iter().map(|task| task.id.to_string()).collect();
            bail!("task {name}: expected one of {}", known.join(", "));
        }
    }
    let is_chosen = |task: &Task| names.iter().any(|name| matches(name, task));
    Ok(tasks.into_iter().filter(is_chosen).collect())
}

fn read(text: &str, assets: &Assets) -> Result<Vec<Task>> {
    let File { state, action, world, inverse_kinematics, grasp, tasks } = toml::from_str(text)?;
    let (state, action) = (state.map(Dimension::from), action.map(Dimension::from));
    let mut read = Vec::new();
    for (name, table) in tasks {
        let place = format!("tasks.{name}");
        let Value::Table(mut own) = table else { bail!("{place}: expected a table, got {table}") };
        let variants = match own.remove("variants") {
            None => Table::new(),
            Some(Value::Table(variants)) => variants,
            Some(other) => bail!("{place}.variants: expected a table, got {other}"),
        };
        ensure!(
            !variants.contains_key(DEFAULT),
            "{place}.variants.{DEFAULT}: expected the default variant in the task's own table"
        );
        let default = (DEFAULT.to_owned(), Value::Table(Table::new()));
        for (variant, changes) in std::iter::once(default).chain(variants) {
            let place = match variant.as_str() {
                DEFAULT => place.clone(),
                variant => format!("{place}.variants.{variant}"),
            };
            let mut table = Value::Table(own.clone());
            merge(&place, &mut table, changes)?;
            let mut rule = TaskRule::deserialize(table).with_context(|| place.clone())?;
            rule.place_distractors().with_context(|| place)?;
            read.push(Task {
                id: TaskId { task: name.clone(), variant },
                assets: assets.clone(),
                rule,
                state: state.to_vec(),
                action: action.to_vec(),
                settings: world.clone(),
                inverse_kinematics: inverse_kinematics.clone(),
                grasp: grasp.clone(),
            });
        }
    }
    Ok(read)
}

/// Merges a variant's values into its task's, key by key in tables.
fn merge(place: &str, own: &mut Value, changes: Value) -> Result<()> {
    match (own, changes) {
        (Value::Table(own), Value::Table(changes)) => {
            for (key, value) in changes {
                match own.get_mut(&key) {
                    Some(current) => merge(&format!("{place}.{key}"), current, value)?,
                    None => _ = own.insert(key, value),
                }
            }
        }
        (own, changes) => {
            ensure!(
                !own.is_table() && !changes.is_table(),
                "{place}: expected a {}, got a {}",
                own.type_str(),
                changes.type_str()
            );
            *own = changes;
        }
    }
    Ok(())
}

impl TaskRule {
    /// Adds the distractors to the layouts of the grid.
    fn place_distractors(&mut self) -> Result<()> {
        let count = self.grid.layouts.len();
        for (index, Distractor { layouts, .. }) in self.distractors.iter().enumerate() {
            ensure!(
                layouts.len() == count,
                "distractors[{index}].layouts: expected {count} rows, one per layout, got {}",
                layouts.len()
            );
            for (layout, pose) in self.grid.layouts.iter_mut().zip(layouts) {
                layout.distractors.push(*pose);
            }
        }
        Ok(())
    }
}
