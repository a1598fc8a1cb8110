//! What an agent and an environment server may say to each other: types, codec, keys; no input or output.
//!
//! An agent reads a server's [`Description`], leases a session with [`Open`] and [`Opening`], and then
//! sends one [`Request`] at a time and waits for its [`Reply`]. Beside that, servers beat
//! ([`Heartbeat`]), agents publish what became of their episodes ([`EpisodeOutcome`]) and a trainer
//! publishes verifiers ([`VerifierUpdate`]). Each message is one MessagePack body on one zenoh key.
//!
//! These types are the specification; `golden/` holds their bytes, and README.md says the rest.

pub mod codec;
pub mod keys;
pub mod limits;
pub mod message;
pub mod transport;

pub use codec::{CodecError, Message, decode, encode};
pub use keys::{KeyError, Keys};
pub use message::*;

/// Version of everything in this crate; peers of another version are refused in words.
pub const PROTOCOL_VERSION: u32 = 3;
