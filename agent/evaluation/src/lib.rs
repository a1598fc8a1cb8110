//! Evaluation: plans suites of episodes before a run, and computes rates, gains and intervals from its records.
//!
//! ```text
//! Suite ─▶ EpisodePlans ─▶ (runtime) ─▶ records ─▶ Results ─▶ table, result file, report page
//! ```

// Planning.
pub mod suite;

// Outcomes.
pub mod comparisons;
pub mod counted;
pub mod estimate;
pub mod results;

// Statistics that do not depend on episodes.
pub mod calibration;
pub mod statistics;

// Presentation.
pub mod headline;
pub mod report;
pub mod result_file;
pub mod table;
pub mod task_names;
