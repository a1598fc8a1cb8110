//! Profiles: how observations and actions of a policy server are mapped to those of the agent.
//!
//! A profile is a TOML file. Its fields are the types below; an unknown field is refused.

mod actions;
mod file;
mod image;
mod state;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};

use crate::Wire;

pub use file::NAMES;

/// A mapping between the agent and a policy server.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Profile {
    /// What the profile is for.
    pub description: String,
    /// What is known about the server.
    #[serde(default)]
    pub server: Server,
    /// The image that the environment renders.
    pub camera: Camera,
    /// The images that the server receives, in the order of the wire.
    pub images: Vec<ImageInput>,
    /// The robot's state, if the server receives it.
    pub state: Option<StateInput>,
    /// The instruction.
    pub prompt: Prompt,
    /// The actions that the server sends.
    pub actions: Actions,
}

/// What is known about a server.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Server {
    /// Whether it draws an action or gives the most likely one.
    pub answers: Answers,
    /// Maximum time until an answer, the first of which may compile the policy.
    pub answer_secs_max: u64,
    /// OpenVLA's `/act` only: the dataset whose statistics it uses.
    pub unnorm_key: Option<String>,
}

/// How a server chooses its action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Answers {
    /// It samples: repeated answers to one observation differ.
    #[default]
    Sampled,
    /// It gives the most likely action.
    Greedy,
}

/// The image that the environment renders.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
}

/// The name of a field on each wire. On a wire without a name the field is not sent.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case", default)]
pub struct Names {
    /// A key of openpi's map.
    pub openpi: Option<String>,
    /// A key of vla-eval's payload; of its `images` for an image.
    pub vla_eval: Option<String>,
    /// A key of the body of OpenVLA's `/act`.
    pub act: Option<String>,
}

/// One image of an observation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageInput {
    /// Its names.
    pub names: Names,
    /// Where its pixels come from.
    pub source: Source,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// How an image of another size is fitted.
    pub resize: Resize,
    /// The order of its dimensions.
    #[serde(default)]
    pub channels: Channels,
}

/// Where an image's pixels come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// The environment's camera.
    Camera,
    /// All pixels are 0, for a camera that the environment does not have.
    Black,
}

/// How an image of another size is fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Resize {
    /// Bilinear with antialiasing, keeping the proportions; black bars fill the rest.
    Pad,
    /// Bilinear with antialiasing, to the whole size.
    Stretch,
    /// Another size is refused.
    Refuse,
}

/// The order of an image's dimensions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Channels {
    /// Height, width, 3.
    #[default]
    Last,
    /// 3, height, width.
    First,
}

/// The robot's state in an observation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StateInput {
    /// Its names.
    pub names: Names,
    /// Its numbers, computed from the environment's state.
    pub values: Vec<StateValue>,
    /// Distance of each finger from the closed position when the gripper is open, in metres.
    #[serde(default)]
    pub finger_open_metres: f64,
}

/// A number computed from a Bridge state: x, y, z in metres, roll, pitch, yaw in radians, 0, and the
/// gripper's opening from 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StateValue {
    /// The whole state of the environment, whatever it is. It stands alone.
    All,
    /// Position of the gripper in the base frame.
    X,
    /// Position.
    Y,
    /// Position.
    Z,
    /// Rotation about the fixed x axis.
    Roll,
    /// Rotation about the fixed y axis.
    Pitch,
    /// Rotation about the fixed z axis.
    Yaw,
    /// Rotation vector.
    RotationX,
    /// Rotation vector.
    RotationY,
    /// Rotation vector.
    RotationZ,
    /// Quaternion.
    QuaternionW,
    /// Quaternion.
    QuaternionX,
    /// Quaternion.
    QuaternionY,
    /// Quaternion.
    QuaternionZ,
    /// 0 closed, 1 open.
    GripperOpen,
    /// 1 closed, 0 open.
    GripperClosed,
    /// Position of one finger in metres.
    Finger,
    /// Position of the other finger in metres, in the opposite direction.
    FingerNegative,
    /// 0.
    Zero,
}

/// The instruction in an observation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Prompt {
    /// Its names.
    pub names: Names,
    /// Whether it is sent in lower case.
    #[serde(default)]
    pub lower_case: bool,
}

/// The actions of a server.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Actions {
    /// Number of dimensions; further numbers of an action are padding, which is dropped.
    pub dimensions: usize,
    /// Maximum number of actions of a chunk that are executed before the next decision.
    pub execute: usize,
    /// Which rotation the dimensions 3 to 5 are.
    pub rotation: Rotation,
    /// What -1 and 1 stand for in each dimension before the gripper, in metres and radians; without
    /// it, numbers are metres and radians.
    pub normalised: Option<Range>,
    /// The gripper command.
    pub gripper: Gripper,
    /// The unit of each dimension when actions are compared.
    pub scale: Vec<f32>,
}

/// Which rotation the dimensions 3 to 5 are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Rotation {
    /// Roll, pitch, yaw about the fixed axes, in radians.
    Euler,
    /// A rotation vector, in radians.
    Vector,
    /// No rotation: the environment has other actions, which are passed on as they are.
    None,
}

/// What -1 and 1 stand for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Range {
    /// The numbers of -1.
    pub low: Vec<f32>,
    /// The numbers of 1.
    pub high: Vec<f32>,
}

/// The gripper command of an action.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "kind", deny_unknown_fields)]
pub enum Gripper {
    /// There is none.
    None,
    /// The last dimension: the nearer of two numbers decides.
    Nearest {
        /// The number that opens.
        open: f32,
        /// The number that closes.
        closed: f32,
    },
    /// The last dimension: mapped linearly to +1 open and -1 closed.
    Linear {
        /// The number that opens.
        open: f32,
        /// The number that closes.
        closed: f32,
    },
}

impl Default for Server {
    fn default() -> Server {
        Server { answers: Answers::default(), answer_secs_max: 120, unnorm_key: None }
    }
}

impl Names {
    /// The name on a wire.
    pub fn on(&self, wire: Wire) -> Option<&str> {
        match wire {
            Wire::OpenPi => self.openpi.as_deref(),
            Wire::VlaEval => self.vla_eval.as_deref(),
            Wire::Act => self.act.as_deref(),
        }
    }
}
