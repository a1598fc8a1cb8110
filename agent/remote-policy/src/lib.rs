//! Policies over a network, in the wires that the field uses: openpi, vla-eval and OpenVLA's `/act`.
//!
//! ```text
//! ProposalRequest ─▶ profile ─▶ codec ─▶ connection ─▶ policy server ─┐
//! Proposal ◀─ profile ◀─ codec ◀──────────────────────────────────────┘
//! ```
//!
//! README.md beside this crate describes the wires and the optional fields that this project adds.

mod address;
pub mod client;
pub mod codec;
pub mod profile;
pub mod server;

pub use address::{Address, Wire};
pub use client::{ClientOptions, RemotePolicy};
pub use profile::Profile;
