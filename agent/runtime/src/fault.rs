//! Why an episode broke: always an error, never an outcome.

use std::fmt;

use decision::DecisionFault;
use protocol::{CodecError, FaultKind, transport};
use store::queue::FaultScope;
use thiserror::Error;

/// What can go wrong between an agent and its environment. The episode is void in every case but
/// [`EnvironmentFault::Refused`], which leaves the world as it was.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EnvironmentFault {
    /// The server's liveliness token is gone: its process has ended.
    ServerLost {
        /// The server's id.
        server: String,
    },
    /// Nothing is connected any more: the router or the network between has failed.
    LinkLost {
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
    pub(crate) fn wire(error: impl fmt::Display) -> Self {
        EnvironmentFault::Wire { reason: printable(&transport::in_words(error)) }
    }

    pub(crate) fn refused(reason: &str) -> Self {
        EnvironmentFault::Refused { reason: printable(reason) }
    }

    pub(crate) fn faulted(kind: FaultKind, reason: &str) -> Self {
        EnvironmentFault::Faulted { kind, reason: printable(reason) }
    }

    /// For a message of ours that was not sent.
    pub(crate) fn unsent(error: &CodecError) -> Self {
        EnvironmentFault::Refused { reason: error.to_string() }
    }
}

impl fmt::Display for EnvironmentFault {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            EnvironmentFault::ServerLost { server } => write!(formatter, "server {server} is gone"),
            EnvironmentFault::LinkLost { server } => {
                write!(formatter, "the link to server {server} is lost")
            }
            EnvironmentFault::TimedOut { server, asked, waited_secs } => {
                write!(
                    formatter,
                    "server {server} is alive but did not answer {asked} for {waited_secs} s"
                )
            }
            EnvironmentFault::Refused { reason } => write!(formatter, "refused: {reason}"),
            EnvironmentFault::Faulted { kind, reason } => write!(formatter, "{kind}: {reason}"),
            EnvironmentFault::Wire { reason } => write!(formatter, "wire: {reason}"),
        }
    }
}

impl std::error::Error for EnvironmentFault {}

/// Why an attempt at an episode has no outcome.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum AttemptFault {
    /// The environment broke, or the way to it.
    #[error("{0}")]
    Environment(#[from] EnvironmentFault),
    /// The policy or the scorer failed.
    #[error("{0}")]
    Decision(#[from] DecisionFault),
    /// The rollout ended meanwhile.
    #[error("stopped")]
    Stopped,
}

impl AttemptFault {
    /// What may be the cause: a server or a link that fails says nothing about the episode.
    pub fn scope(&self) -> FaultScope {
        match self {
            AttemptFault::Environment(fault) => match fault {
                EnvironmentFault::Refused { .. } | EnvironmentFault::Faulted { .. } => {
                    FaultScope::Episode
                }
                EnvironmentFault::ServerLost { .. }
                | EnvironmentFault::TimedOut { .. }
                | EnvironmentFault::Wire { .. } => FaultScope::Server,
                EnvironmentFault::LinkLost { .. } => FaultScope::Link,
            },
            AttemptFault::Decision(_) => FaultScope::Episode,
            AttemptFault::Stopped => FaultScope::Link,
        }
    }
}

/// Text of a peer without control characters: it reaches terminals, logs and pages.
pub(crate) fn printable(text: &str) -> String {
    text.chars().map(|letter| if letter.is_control() { '\u{fffd}' } else { letter }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_of_a_server_do_not_reach_the_terminal() {
        let fault = EnvironmentFault::refused("go away \u{1b}[31m\r\n");
        assert_eq!(fault.to_string(), "refused: go away \u{fffd}[31m\u{fffd}\u{fffd}");
    }
}
