//! What a policy sees before a decision.

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use super::{strict, value};
use crate::limits::{ACTION_DIMENSIONS_MAX, STATE_DIMENSIONS_MAX};

/// A picture; 0 x 0 where none was asked for.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Image {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// height × width × 3 bytes: rows from the top, red green blue.
    pub pixels: Bytes,
}

/// Everything that a policy may know, and on request the expert's opinion.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Observation {
    /// The camera's picture in the size that was asked for at `Open`.
    pub image: Image,
    /// As the task's description says. Of a Bridge task: x y z in metres, roll pitch yaw in radians, 0, gripper
    /// opening 0 to 1; base frame.
    #[serde(deserialize_with = "strict::floats")]
    pub state: Vec<f32>,
    /// What the robot is told to do.
    pub instruction: String,
    /// The scripted expert's action at this state; only in a session opened with `expert`.
    #[serde(deserialize_with = "strict::optional_floats")]
    pub expert_action: Option<Vec<f32>>,
}

impl Image {
    pub(crate) fn validate(&self) -> Result<(), String> {
        self.validate_sides()?;
        let bytes = self.height * self.width * 3;
        if self.pixels.len() != bytes {
            return Err(format!(
                "image: expected {bytes} bytes for {} x {} pixels, got {}",
                self.height,
                self.width,
                self.pixels.len()
            ));
        }
        Ok(())
    }

    pub(super) fn validate_sides(&self) -> Result<(), String> {
        let fields = ["image height", "image width"];
        value::image_sides(fields, self.height as u64, self.width as u64)
    }
}

impl Observation {
    pub(crate) fn validate(&self) -> Result<(), String> {
        self.image.validate()?;
        self.validate_rest()
    }

    /// All but the image.
    pub(super) fn validate_rest(&self) -> Result<(), String> {
        value::length("state", self.state.len(), 0, STATE_DIMENSIONS_MAX)?;
        value::finite("state", &self.state)?;
        value::text("instruction", &self.instruction)?;
        let Some(action) = &self.expert_action else { return Ok(()) };
        value::length("expert_action", action.len(), 1, ACTION_DIMENSIONS_MAX)?;
        value::finite("expert_action", action)
    }
}
