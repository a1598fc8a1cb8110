//! Why an episode broke: always an error, never an outcome.

use std::fmt;

use protocol::{CodecError, FaultKind};

/// What can go wrong between an agent and its environment. The episode is void in every case but
/// [`EnvironmentFault::Refused`], which leaves the world as it was.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EnvironmentFault {
    /// The server's liveliness token is gone: its process or the way to it ended.
    ServerLost {
        /// The server's id.
        server: String,
    },
    /// No answer came though the server's process lives: its simulation is stuck, or far too slow.
    TimedOut {
        /// The server's id.
        server: String,
        /// What was asked.
        asked: &'static str,
        /// How long an answer was waited for.
        waited_secs: u64,
    },
    /// The server, or the codec before it, says that the request is wrong.
    Refused {
        /// What was expected and what came.
        reason: String,
    },
    /// The world broke.
    Faulted {
        /// What broke.
        kind: FaultKind,
        /// In the server's words.
        reason: String,
    },
    /// The network itself failed, or a message is not what the protocol says.
    Wire {
        /// What was expected and what came.
        reason: String,
    },
}

impl EnvironmentFault {
    pub(super) fn wire(error: impl fmt::Display) -> Self {
        EnvironmentFault::Wire { reason: error.to_string() }
    }

    /// For a message of ours that was not sent.
    pub(super) fn unsent(error: &CodecError) -> Self {
        EnvironmentFault::Refused { reason: error.to_string() }
    }
}

impl fmt::Display for EnvironmentFault {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            EnvironmentFault::ServerLost { server } => write!(formatter, "server {server} is gone"),
            EnvironmentFault::TimedOut { server, asked, waited_secs } => {
                write!(
                    formatter,
                    "server {server} lives but did not answer {asked} for {waited_secs} s"
                )
            }
            EnvironmentFault::Refused { reason } => write!(formatter, "refused: {reason}"),
            EnvironmentFault::Faulted { kind, reason } => write!(formatter, "{kind}: {reason}"),
            EnvironmentFault::Wire { reason } => write!(formatter, "wire: {reason}"),
        }
    }
}

impl std::error::Error for EnvironmentFault {}
