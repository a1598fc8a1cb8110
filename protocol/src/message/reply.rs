//! A server's reply, which repeats the request's number.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Observation, Statistics, strict, value};
use crate::codec::Message;
use crate::limits::REPLY_BYTES_MAX;

/// The result of one control step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Transition {
    /// The observation after the step.
    pub observation: Observation,
    /// The statistics at this step.
    pub statistics: Statistics,
    /// 1 if the task is solved at this step, otherwise 0.
    #[serde(deserialize_with = "strict::float")]
    pub reward: f32,
    /// The task ended the episode.
    pub terminated: bool,
    /// The episode reached its horizon.
    pub truncated: bool,
}

/// What failed in the environment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum FaultKind {
    /// The physics became infinite or implausible.
    PhysicsDiverged,
    /// No image could be rendered.
    RendererUnavailable,
    /// Anything else: a defect of the server, described in its log.
    Internal,
}

/// Sent exactly once for each request that is not older than the last one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub enum Reply {
    /// Reply to `Reset`.
    Observed {
        /// The request's number.
        sequence: u64,
        /// The observation at the start of the episode.
        observation: Observation,
    },
    /// Reply to `Step`.
    Stepped {
        /// The request's number.
        sequence: u64,
        /// The step's result.
        transition: Transition,
        /// `None`: the image is complete. Otherwise `pixels` holds only these tiles of 16 x 16
        /// pixels, one after the other; tiles are numbered row by row. All other tiles are as in
        /// the session's last observation ([`super::Image::complete`]).
        #[serde(deserialize_with = "strict::optional")]
        changed_tiles: Option<Vec<u32>>,
        /// Time in the simulator in microseconds: physics, rendering and success check, without the
        /// transport.
        simulator_us: u32,
    },
    /// Reply to `Save`.
    Saved {
        /// The request's number.
        sequence: u64,
    },
    /// Reply to `Restore`.
    Restored {
        /// The request's number.
        sequence: u64,
        /// The observation in the restored state.
        observation: Observation,
    },
    /// Reply to `Close`.
    Closed {
        /// The request's number.
        sequence: u64,
    },
    /// The request was invalid and the environment is unchanged. The number is 0 if the request
    /// could not be decoded or the session has ended.
    Refused {
        /// The request's number, or 0.
        sequence: u64,
        /// What was expected and what was received.
        reason: String,
    },
    /// The environment failed. The episode is void; only `Reset` or `Close` may follow.
    Faulted {
        /// The request's number.
        sequence: u64,
        /// What failed.
        kind: FaultKind,
        /// A short reason; the server's log has the details.
        reason: String,
    },
}

impl Reply {
    /// The number of the request that this replies to; 0 if it is unknown.
    pub fn sequence(&self) -> u64 {
        match self {
            Reply::Observed { sequence, .. }
            | Reply::Stepped { sequence, .. }
            | Reply::Saved { sequence }
            | Reply::Restored { sequence, .. }
            | Reply::Closed { sequence }
            | Reply::Refused { sequence, .. }
            | Reply::Faulted { sequence, .. } => *sequence,
        }
    }

    /// The name of the variant, for errors.
    pub fn kind(&self) -> &'static str {
        match self {
            Reply::Observed { .. } => "Observed",
            Reply::Stepped { .. } => "Stepped",
            Reply::Saved { .. } => "Saved",
            Reply::Restored { .. } => "Restored",
            Reply::Closed { .. } => "Closed",
            Reply::Refused { .. } => "Refused",
            Reply::Faulted { .. } => "Faulted",
        }
    }
}

impl Message for Reply {
    const NAME: &'static str = "reply";
    const BYTES_MAX: usize = REPLY_BYTES_MAX;

    fn validate(&self) -> Result<(), String> {
        value::sequence(
            self.sequence(),
            if matches!(self, Reply::Refused { .. }) { 0 } else { 1 },
        )?;
        match self {
            Reply::Observed { observation, .. } | Reply::Restored { observation, .. } => {
                observation.validate()
            }
            Reply::Stepped { transition, changed_tiles, .. } => {
                let observation = &transition.observation;
                match changed_tiles {
                    None => observation.image.validate()?,
                    Some(tiles) => observation.image.validate_tiles(tiles)?,
                }
                observation.validate_rest()?;
                value::finite("reward", &[transition.reward])
            }
            Reply::Refused { reason, .. } | Reply::Faulted { reason, .. } => {
                value::text("reason", reason)
            }
            Reply::Saved { .. } | Reply::Closed { .. } => Ok(()),
        }
    }
}

impl fmt::Display for FaultKind {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            FaultKind::PhysicsDiverged => "physics diverged",
            FaultKind::RendererUnavailable => "renderer unavailable",
            FaultKind::Internal => "internal fault",
        })
    }
}
