//! What a server says about itself.

use serde::{Deserialize, Serialize};

use super::{strict, value};
use crate::codec::Message;
use crate::limits::{
    ACTION_DIMENSIONS_MAX, DESCRIPTION_BYTES_MAX, IMAGE_SIDE_MAX, SESSIONS_MAX, SLOTS_MAX,
    STATE_DIMENSIONS_MAX,
};

/// One number of a state or of an action.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dimension {
    /// What it is, such as `x` or `gripper`.
    pub name: String,
    /// Lowest value, where there is one.
    #[serde(deserialize_with = "strict::optional_float")]
    pub low: Option<f32>,
    /// Highest value, where there is one.
    #[serde(deserialize_with = "strict::optional_float")]
    pub high: Option<f32>,
    /// Whether only the whole numbers from `low` to `high` count.
    pub discrete: bool,
}

/// One task in one variant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskDescription {
    /// Its name; of the Bridge tasks, SIMPLER's.
    pub task: String,
    /// `default`, or what is changed.
    pub variant: String,
    /// Rises when results of the task may change.
    pub version: u32,
    /// What the robot is told to do.
    pub instruction: String,
    /// Steps after which an episode is truncated.
    pub steps_max: u32,
    /// Control steps per second of simulated time, where it is known.
    #[serde(deserialize_with = "strict::optional_float")]
    pub control_hz: Option<f32>,
    /// Fixed layouts, numbered from 0; the random ones lie beside them.
    pub layouts: u32,
    /// What the numbers of a state are.
    pub state: Vec<Dimension>,
    /// What the numbers of an action are.
    pub action: Vec<Dimension>,
}

/// The answer to a query on `describe`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// Version of the protocol that the server speaks.
    pub protocol: u32,
    /// The server's id, as in its keys.
    pub server: String,
    /// Name of the simulator.
    pub simulator: String,
    /// Its version, with that of the physics engine; results are comparable within one of these.
    pub simulator_version: String,
    /// Every task in every variant.
    pub tasks: Vec<TaskDescription>,
    /// Largest height and width of an image; 0 where there are none.
    pub image_side_max: u32,
    /// Sessions in use.
    pub sessions: u32,
    /// Sessions that can be in use.
    pub sessions_max: u32,
    /// Save slots of a session.
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
