//! Faults: why an attempt failed. A fault is always an error, never an outcome.

use std::fmt;

use decision::DecisionFault;
use protocol::{CodecError, FaultKind, transport};
use store::queue::FaultScope;
use thiserror::Error;

use crate::rollout::NeverWellFormed;

/// A fault of the environment or of the connection to it. The episode is void after every fault
/// except [`EnvironmentFault::Refused`], which leaves the environment unchanged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EnvironmentFault {
    /// The server's liveliness token disappeared: its process ended.
    ServerLost {
        /// The server's id.
        server: String,
    },
    /// Nothing is connected any more: the router or the network failed.
    LinkLost {
        /// The server's id.
        server: String,
    },
    /// The server process is alive but did not reply: its simulation is stuck or far too slow.
    TimedOut {
        /// The server's id.
        server: String,
        /// The request that was sent.
        asked: &'static str,
        /// How long the agent waited for a reply.
        waited_secs: u64,
    },
    /// The server or the encoder rejected the request.
    Refused {
        /// What was expected and what was received.
        reason: String,
    },
    /// The environment failed.
    Faulted {
        /// What failed.
        kind: FaultKind,
        /// The server's reason.
        reason: String,
    },
    /// The network failed, or a message violates the protocol.
    Wire {
        /// What was expected and what was received.
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

    /// For a message that could not be encoded and was not sent.
    pub(crate) fn unsent(error: &CodecError) -> Self {
        EnvironmentFault::Refused { reason: error.to_string() }
    }
}

impl fmt::Display for EnvironmentFault {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            EnvironmentFault::ServerLost { server } => {
                write!(formatter, "server {server} was lost: its process ended")
            }
            EnvironmentFault::LinkLost { server } => {
                write!(formatter, "the connection to server {server} was lost")
            }
            EnvironmentFault::TimedOut { server, asked, waited_secs } => {
                write!(
                    formatter,
                    "server {server} is alive but did not reply to {asked} for {waited_secs} s"
                )
            }
            EnvironmentFault::Refused { reason } => write!(formatter, "refused: {reason}"),
            EnvironmentFault::Faulted { kind, reason } => write!(formatter, "{kind}: {reason}"),
            EnvironmentFault::Wire { reason } => {
                write!(formatter, "protocol or network error: {reason}")
            }
        }
    }
}

impl std::error::Error for EnvironmentFault {}

/// Why an attempt has no outcome.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum AttemptFault {
    /// The environment or the connection to it failed.
    #[error("{0}")]
    Environment(#[from] EnvironmentFault),
    /// The policy or the scorer failed.
    #[error("{0}")]
    Decision(#[from] DecisionFault),
    /// No candidate of the policy was ever well formed; the run ends.
    #[error("{0}")]
    NeverWellFormed(#[from] NeverWellFormed),
    /// The rollout was stopped during the attempt.
    #[error("stopped")]
    Stopped,
}

impl AttemptFault {
    /// The scope of the fault: a failed server or connection says nothing about the episode.
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
            AttemptFault::Decision(_) | AttemptFault::NeverWellFormed(_) => FaultScope::Episode,
            AttemptFault::Stopped => FaultScope::Link,
        }
    }
}

/// Replaces control characters in a peer's text, which is shown in terminals, logs and pages.
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
