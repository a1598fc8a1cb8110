//! The agent's end of the protocol: the only place that imports zenoh.
//!
//! [`Network`] finds servers in the background, [`ZenohPool`] opens sessions where there is room, [`Environment`] leases
//! one and [`Episode`] is the only thing that can step it. [`OutcomePublisher`] tells observers what came of episodes,
//! [`VerifierPublisher`] and [`VerifierSubscriber`] carry newly trained verifiers.

mod discovery;
mod environment;
mod episode;
mod local_endpoint;
mod network;
mod offer;
mod outcomes;
mod pool;
mod pool_state;
mod probe;
mod verifier_updates;

pub use discovery::Fleet;
pub use environment::Environment;
pub use episode::Episode;
pub use network::{Network, NetworkOptions, Timing, check_endpoint};
pub use outcomes::OutcomePublisher;
pub use pool::{PoolOptions, ZenohPool};
pub use probe::Probe;
pub use protocol::Description as ServerDescription;
pub use protocol::Reset;
pub use verifier_updates::{VerifierPublisher, VerifierSubscriber};
