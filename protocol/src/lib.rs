//! The wire protocol between an agent and an environment server: types, codec, keys. No I/O.
//!
//! An agent reads a server's [`Description`], leases a session with [`Open`] and [`Opening`], and
//! then sends one [`Request`] at a time and waits for its [`Reply`]. In addition, servers send
//! [`Heartbeat`]s, agents publish the outcome of each episode ([`EpisodeOutcome`]), and a trainer
//! publishes verifiers ([`VerifierUpdate`]). Each message is one MessagePack body on one zenoh key.
//!
//! These types are the specification. `golden/` holds their encodings; README.md explains the rules
//! between messages.

pub mod codec;
pub mod keys;
pub mod limits;
pub mod message;
pub mod transport;

pub use codec::{CodecError, Message, decode, encode};
pub use keys::{KeyError, Keys};
pub use message::*;

/// Version of the protocol. A peer of another version is refused with a reason.
pub const PROTOCOL_VERSION: u32 = 3;
