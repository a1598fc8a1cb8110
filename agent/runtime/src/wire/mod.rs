//! The agent's end of the protocol: the only place that imports zenoh.
//!
//! [`Network`] finds servers, [`Environment`] leases a session of one and [`Episode`] is the only
//! thing that can step it. [`OutcomePublisher`] and [`OutcomeSubscriber`] carry what became of
//! episodes, [`VerifierPublisher`] and [`VerifierSubscriber`] carry newly trained verifiers.

mod environment;
mod episode;
mod fault;
mod network;
mod outcomes;
mod probe;
mod servers;
mod verifier_updates;

pub use environment::Environment;
pub use episode::{ACTION_LENGTH, Episode, STATE_LENGTH};
pub use fault::EnvironmentFault;
pub use network::{Network, NetworkOptions, Timing};
pub use outcomes::{OutcomePublisher, OutcomeSubscriber};
pub use probe::Probe;
pub use protocol::Description as ServerDescription;
pub use protocol::Reset;
pub use verifier_updates::{VerifierPublisher, VerifierSubscriber};
