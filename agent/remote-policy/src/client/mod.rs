//! A policy server as a policy.

mod act;
mod candidates;
mod connection;
mod episodes;
mod openpi;
mod policy;
mod socket;
#[cfg(test)]
mod tests;
mod vla_eval;

pub use policy::{ClientOptions, RemotePolicy};
