//! The input of a policy's decision.

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use super::{strict, value};
use crate::limits::{ACTION_DIMENSIONS_MAX, STATE_DIMENSIONS_MAX};

/// An RGB image; 0 x 0 if the session has no images.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Image {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// height × width × 3 bytes, 8 bits per channel: rows from the top, each pixel red, green,
    /// blue.
    pub pixels: Bytes,
}

/// Everything that a policy may use and, on request, the scripted expert's action.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Observation {
    /// The camera image, in the size requested by `Open`.
    pub image: Image,
    /// The robot's state, with the dimensions in the task's description. For a Bridge task: x, y, z
    /// in metres, roll, pitch, yaw in radians, 0, and the gripper opening from 0 to 1, in the base
    /// frame.
    #[serde(deserialize_with = "strict::floats")]
    pub state: Vec<f32>,
    /// The language instruction for the robot.
    pub instruction: String,
    /// The scripted expert's action in this state; only in a session opened with `expert`.
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

    /// All fields except the image.
    pub(super) fn validate_rest(&self) -> Result<(), String> {
        value::length("state", self.state.len(), 0, STATE_DIMENSIONS_MAX)?;
        value::finite("state", &self.state)?;
        value::text("instruction", &self.instruction)?;
        let Some(action) = &self.expert_action else { return Ok(()) };
        value::length("expert_action", action.len(), 1, ACTION_DIMENSIONS_MAX)?;
        value::finite("expert_action", action)
    }
}
