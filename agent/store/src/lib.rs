//! Stores episodes and runs, and queues the episodes that are still to be run.
//!
//! ```text
//! EpisodePlan x Setting ─▶ EpisodeQueue ─▶ (runtime) ─▶ EpisodeRecord ─▶ Run: record, index, label
//! ```
//!
//! The records are the source of truth: index, labels, tables and videos can be rebuilt from them.
//! An episode that ends in a fault has no record, so that a fault never becomes a label.

// Episodes to run.
pub mod plan;
pub mod queue;

// Stored data.
mod identity;
pub mod labels;
pub mod provenance;
pub mod record;
pub mod run;
pub mod video;

// Writing and comparing files.
mod digest;
mod durable;

pub use digest::{combined_digest, episode_digest, hex};
pub use durable::{check_writable, write_whole};
