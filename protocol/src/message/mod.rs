//! The messages, in the order in which an agent uses them.

mod description;
mod heartbeat;
mod observation;
mod open;
mod outcome;
mod reply;
mod request;
mod statistics;
mod strict;
mod tiles;
mod value;
mod verifier_update;

pub use description::{Description, Dimension, TaskDescription};
pub use heartbeat::Heartbeat;
pub use observation::{Image, Observation};
pub use open::{Open, Opening};
pub use outcome::EpisodeOutcome;
pub use reply::{FaultKind, Reply, Transition};
pub use request::{Request, Reset};
pub use statistics::Statistics;
pub use verifier_update::VerifierUpdate;
