//! The agent's side of the protocol; the only module that imports zenoh.
//!
//! [`Network`] discovers servers in the background, [`ZenohPool`] opens sessions on servers with
//! free ones, [`Environment`] leases a session and only [`Episode`] can step it.
//! [`OutcomePublisher`] publishes outcomes for observers; [`VerifierPublisher`] and
//! [`VerifierSubscriber`] transfer newly trained verifiers.

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
