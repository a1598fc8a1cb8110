//! The agent as a policy server: openpi's and vla-eval's WebSockets and OpenVLA's `/act` on one
//! port.
//!
//! ```text
//! socket ─▶ http ─▶ connection ─▶ openpi | vla_eval ─▶ observation ─▶ session ─▶ DecisionBatcher
//!                └▶ act ──────────────────────────────────┘    reply ◀─ Decision ◀──┘
//! ```
//!
//! Decisions of all clients share batches. A decision depends only on the client's own observation,
//! episode and seed, never on the other clients.

mod act;
mod action_form;
mod agent;
mod connection;
mod http;
mod key;
mod listen;
mod observation;
mod openpi;
mod reply;
mod session;
mod vla_eval;

pub use action_form::{ActionForm, Gripper, Rotation};
pub use agent::{AgentOptions, CANDIDATES_MAX, ServedAgent};
pub use key::ApiKey;
pub use listen::{MESSAGE_BYTES_MAX, ServerOptions, serve};
pub use observation::ObservationKeys;

#[cfg(test)]
mod tests;
