//! What a server offers: its tasks, and the meaning of their states and actions.

use serde::{Deserialize, Serialize};

use super::{strict, value};
use crate::codec::Message;
use crate::limits::{
    ACTION_DIMENSIONS_MAX, DESCRIPTION_BYTES_MAX, IMAGE_SIDE_MAX, SESSIONS_MAX, SLOTS_MAX,
    STATE_DIMENSIONS_MAX,
};

/// One dimension of a state or of an action.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dimension {
    /// Its name, such as `x` or `gripper`.
    pub name: String,
    /// Lower bound, if there is one.
    #[serde(deserialize_with = "strict::optional_float")]
    pub low: Option<f32>,
    /// Upper bound, if there is one.
    #[serde(deserialize_with = "strict::optional_float")]
    pub high: Option<f32>,
    /// Whether only the whole numbers from `low` to `high` are valid.
    pub discrete: bool,
}

/// One task in one variant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskDescription {
    /// Name of the task. The Bridge tasks have SIMPLER's names.
    pub task: String,
    /// `default`, or the name of what is changed.
    pub variant: String,
    /// Increases when results of the task may change.
    pub version: u32,
    /// The language instruction for the robot.
    pub instruction: String,
    /// Horizon: an episode is truncated after so many steps.
    pub steps_max: u32,
    /// Control steps per second of simulated time, if known.
    #[serde(deserialize_with = "strict::optional_float")]
    pub control_hz: Option<f32>,
    /// Number of fixed initial layouts, numbered from 0. Random layouts exist in addition to them.
    pub layouts: u32,
    /// The dimensions of a state.
    pub state: Vec<Dimension>,
    /// The dimensions of an action.
    pub action: Vec<Dimension>,
}

/// The reply to a query on `describe`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// Version of the protocol that the server uses.
    pub protocol: u32,
    /// The server's id, as in its keys.
    pub server: String,
    /// Name of the simulator.
    pub simulator: String,
    /// Its version with the version of the physics engine. Results are comparable only within one
    /// such version.
    pub simulator_version: String,
    /// Every task in every variant.
    pub tasks: Vec<TaskDescription>,
    /// Maximum height and width of an image; 0 if the server has no images.
    pub image_side_max: u32,
    /// Sessions in use.
    pub sessions: u32,
    /// Maximum number of sessions in use.
    pub sessions_max: u32,
    /// Number of save slots of a session.
    pub slots_max: u32,
}

impl Dimension {
    fn validate(&self) -> Result<(), String> {
        value::name("dimension", &self.name)?;
        let bounds: Vec<f32> = self.low.into_iter().chain(self.high).collect();
        value::finite(&format!("dimension {}", self.name), &bounds)?;
        let is_whole = bounds.len() == 2 && bounds.iter().all(|bound| bound.fract() == 0.0);
        if self.discrete && !is_whole {
            return Err(format!(
                "dimension {}: expected whole bounds, for it is discrete",
                self.name
            ));
        }
        match bounds[..] {
            [low, high] if low > high => {
                Err(format!("dimension {}: expected low <= high, got {low} and {high}", self.name))
            }
            _ => Ok(()),
        }
    }
}

impl Message for Description {
    const NAME: &'static str = "description";
    const BYTES_MAX: usize = DESCRIPTION_BYTES_MAX;

    fn recognise(bytes: &[u8]) -> Result<(), String> {
        value::recognise_protocol(bytes)
    }

    fn validate(&self) -> Result<(), String> {
        value::protocol(self.protocol)?;
        value::name("server", &self.server)?;
        value::name("simulator", &self.simulator)?;
        value::name("simulator_version", &self.simulator_version)?;
        value::elements("tasks", self.tasks.len())?;
        for task in &self.tasks {
            value::name("task", &task.task)?;
            value::name("variant", &task.variant)?;
            value::text("instruction", &task.instruction)?;
            value::range("steps_max", task.steps_max.into(), 1, 1_000_000)?;
            if let Some(rate) = task.control_hz {
                value::positive("control_hz", rate)?;
            }
            value::length("state", task.state.len(), 0, STATE_DIMENSIONS_MAX)?;
            value::length("action", task.action.len(), 1, ACTION_DIMENSIONS_MAX)?;
            task.state.iter().chain(&task.action).try_for_each(Dimension::validate)?;
        }
        value::range("image_side_max", self.image_side_max.into(), 0, IMAGE_SIDE_MAX as u64)?;
        value::range("sessions_max", self.sessions_max.into(), 1, SESSIONS_MAX.into())?;
        value::range("sessions", self.sessions.into(), 0, self.sessions_max.into())?;
        value::range("slots_max", self.slots_max.into(), 0, SLOTS_MAX.into())
    }
}
