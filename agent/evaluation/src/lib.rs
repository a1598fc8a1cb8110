//! What is computed from records: suites of episodes before a run, rates, gains and intervals after it.
//!
//! ```text
//! Suite ─▶ EpisodePlans ─▶ (runtime) ─▶ records ─▶ Results ─▶ table, result file, report page
//! ```

// Which episodes.
pub mod suite;

// What came of them.
pub mod comparisons;
pub mod counted;
pub mod estimate;
pub mod results;

// Statistics that know nothing of episodes.
pub mod calibration;
pub mod statistics;

// How it is shown.
pub mod headline;
pub mod report;
pub mod result_file;
pub mod table;
pub mod task_names;
