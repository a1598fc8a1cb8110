//! What a server answers, echoing the request's number.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{Observation, Statistics, strict, value};
use crate::codec::Message;
use crate::limits::REPLY_BYTES_MAX;

/// The result of one control step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Transition {
    /// After the step.
    pub observation: Observation,
    /// As of this step.
    pub statistics: Statistics,
    /// 1 when the task is solved at this step, else 0.
    #[serde(deserialize_with = "strict::float")]
    pub reward: f32,
    /// The task itself ended the episode.
    pub terminated: bool,
    /// The horizon ended the episode.
    pub truncated: bool,
}

/// What broke in the world.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum FaultKind {
    /// The physics left the finite or the plausible.
    PhysicsDiverged,
    /// No picture could be made.
    RendererUnavailable,
    /// Anything else: a defect of the server, told in its log.
    Internal,
}

/// Exactly one for each request that is not older than the last one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub enum Reply {
    /// To `Reset`.
    Observed {
        /// The request's number.
        sequence: u64,
        /// At the episode's start.
        observation: Observation,
    },
    /// To `Step`.
    Stepped {
        /// The request's number.
        sequence: u64,
        /// The step's result.
        transition: Transition,
        /// None: the image is whole. Else its `pixels` are those of these tiles of 16 x 16 pixels only, numbered row by
        /// row, one tile after the other; the others are as in the session's last observation ([`super::Image::complete`]).
        #[serde(deserialize_with = "strict::optional")]
        changed_tiles: Option<Vec<u32>>,
        /// Microseconds that the simulator took for it: physics, picture and judge, without the wire.
        simulator_us: u32,
    },
    /// To `Save`.
    Saved {
        /// The request's number.
        sequence: u64,
    },
    /// To `Restore`.
    Restored {
        /// The request's number.
        sequence: u64,
        /// At the restored state.
        observation: Observation,
    },
    /// To `Close`.
    Closed {
        /// The request's number.
        sequence: u64,
    },
    /// The request was wrong; the world is unchanged. Number 0 when the request's own could not be read, or when the
    /// session has ended.
    Refused {
        /// The request's number, or 0.
        sequence: u64,
        /// What was expected and what came.
        reason: String,
    },
    /// The world broke: the episode is void, and only `Reset` or `Close` can follow.
    Faulted {
        /// The request's number.
        sequence: u64,
        /// What broke.
        kind: FaultKind,
        /// In short; the server's log has more.
        reason: String,
    },
}

impl Reply {
    /// The number of the request that this answers; 0 when that is unknown.
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

    /// The message's name, for errors.
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
