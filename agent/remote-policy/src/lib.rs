//! Policies over a network, in the wires that the field uses: openpi, vla-eval and OpenVLA's `/act`.
//!
//! ```text
//! ProposalRequest ─▶ profile ─▶ codec ─▶ socket ─▶ policy server ─▶ codec ─▶ profile ─▶ Proposal
//! ```
//!
//! README.md beside this crate describes the wires and the optional fields that this project adds.

pub mod codec;
pub mod server;
