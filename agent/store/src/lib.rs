//! What is kept of episodes, and what is still to be run.
//!
//! ```text
//! EpisodePlan x Setting ─▶ queue ─▶ (runtime) ─▶ EpisodeRecord ─▶ run folder: record, index, label
//! ```
//!
//! The records are the truth: index, labels, tables and videos can be rebuilt from them. There is no record of an episode
//! that broke: a fault leaves nothing behind that could become a label.

// What is still to be run.
pub mod plan;
pub mod queue;

// What is kept.
pub mod labels;
pub mod record;
pub mod run;
pub mod video;
