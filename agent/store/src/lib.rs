//! What is kept of episodes, and what is still to be run.
//!
//! ```text
//! EpisodePlan x Setting ─▶ EpisodeQueue ─▶ (runtime) ─▶ EpisodeRecord ─▶ Run: record file, then index and label together
//! ```
//!
//! The records are the truth: index, labels, tables and videos can be rebuilt from them. There is no record of an episode
//! that broke: a fault leaves nothing behind that could become a label.

// What is still to be run.
pub mod plan;
pub mod queue;

// What is kept.
mod identity;
pub mod labels;
pub mod provenance;
pub mod record;
pub mod run;
pub mod video;

// How it is kept, and how it is compared.
mod digest;
mod durable;

pub use digest::{combined_digest, episode_digest, hex};
pub use durable::{check_writable, write_whole};
