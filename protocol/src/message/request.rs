//! The requests of a session's holder, sent one at a time.

use serde::{Deserialize, Serialize};

use super::{strict, value};
use crate::codec::Message;
use crate::limits::{ACTION_DIMENSIONS_MAX, REQUEST_BYTES_MAX, SEED_END, SLOTS_MAX};

/// Everything that determines the start of an episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reset {
    /// Name of the task in the server's description.
    pub task: String,
    /// `default`, or the name of what is changed.
    pub variant: String,
    /// Number of the fixed initial layout; `None` generates a layout from the seed.
    pub layout: Option<u32>,
    /// Below 2^53.
    pub seed: u64,
}

/// A request. Its number in the session counts 1, 2, 3 and so on.
///
/// The server answers a repeated number with the same bytes again, ignores a lower number, and
/// refuses a gap.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub enum Request {
    /// Starts an episode and ends the previous one. Answered with `Observed`.
    Reset {
        /// This request's number.
        sequence: u64,
        /// Name of the task in the server's description.
        task: String,
        /// `default`, or the name of what is changed.
        variant: String,
        /// Number of the fixed initial layout; `None` generates a layout from the seed.
        #[serde(deserialize_with = "strict::optional")]
        layout: Option<u32>,
        /// Below 2^53.
        seed: u64,
    },
    /// One control step. Answered with `Stepped`.
    Step {
        /// This request's number.
        sequence: u64,
        /// The action, with the dimensions in the task's description. For a Bridge task:
        /// translation in metres, rotation vector in radians, gripper +1 open or -1 closed, in the
        /// base frame.
        #[serde(deserialize_with = "strict::floats")]
        action: Vec<f32>,
    },
    /// Saves the state in a slot until the next `Reset`. Answered with `Saved`.
    Save {
        /// This request's number.
        sequence: u64,
        /// Number of the slot, from 0.
        slot: u32,
    },
    /// Restores the state in a slot, bit by bit. Answered with `Restored`.
    Restore {
        /// This request's number.
        sequence: u64,
        /// Number of the slot, from 0.
        slot: u32,
    },
    /// Ends the session. Answered with `Closed`.
    Close {
        /// This request's number.
        sequence: u64,
    },
}

impl Request {
    /// The request's number.
    pub fn sequence(&self) -> u64 {
        match self {
            Request::Reset { sequence, .. }
            | Request::Step { sequence, .. }
            | Request::Save { sequence, .. }
            | Request::Restore { sequence, .. }
            | Request::Close { sequence } => *sequence,
        }
    }
}

impl Message for Request {
    const NAME: &'static str = "request";
    const BYTES_MAX: usize = REQUEST_BYTES_MAX;

    fn validate(&self) -> Result<(), String> {
        value::sequence(self.sequence(), 1)?;
        match self {
            Request::Reset { task, variant, seed, .. } => {
                value::name("task", task)?;
                value::name("variant", variant)?;
                value::range("seed", *seed, 0, SEED_END - 1)
            }
            Request::Step { action, .. } => {
                value::length("action", action.len(), 1, ACTION_DIMENSIONS_MAX)?;
                value::finite("action", action)
            }
            Request::Save { slot, .. } | Request::Restore { slot, .. } => {
                value::range("slot", (*slot).into(), 0, u64::from(SLOTS_MAX) - 1)
            }
            Request::Close { .. } => Ok(()),
        }
    }
}
