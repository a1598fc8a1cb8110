//! The part of a record that tables use.

use protocol::Statistics;
use serde::{Deserialize, Serialize};

use crate::record::{DecisionRecord, EpisodeIdentity, EpisodeRecord};

/// One recorded episode. An index whose summaries have other fields is not used.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeSummary {
    /// Which episode.
    pub identity: EpisodeIdentity,
    /// The statistics at the last step.
    pub statistics: Statistics,
    /// The simulator and its version.
    pub simulator: String,
    /// Number of control steps.
    pub steps: u32,
    /// Number of decisions without a well-formed candidate.
    pub held_steps: u32,
    /// Number of malformed candidates.
    pub malformed: u32,
    /// Number of candidates.
    pub candidates: u32,
    /// Seconds from the reset to the last step.
    pub wall_secs: f32,
    /// For each decision: its share of its batch's time.
    pub decision_ms: Vec<f32>,
    /// For each decision: the number of decisions in its batch, including itself.
    pub batch_size: Vec<u32>,
    /// For each step: time from the action to the next observation.
    pub step_ms: Vec<f32>,
    /// For each step: the server's part of that time.
    pub simulator_ms: Vec<f32>,
}

impl EpisodeSummary {
    /// Whether the episode has an outcome, see [`EpisodeRecord::has_outcome`].
    pub fn has_outcome(&self) -> bool {
        (self.held_steps as usize) < self.decision_ms.len()
    }
}

impl From<&EpisodeRecord> for EpisodeSummary {
    fn from(record: &EpisodeRecord) -> EpisodeSummary {
        let candidates = || record.decisions().flat_map(|decision| &decision.candidates);
        EpisodeSummary {
            identity: record.identity.clone(),
            statistics: record.statistics,
            simulator: record.versions.simulator.clone(),
            steps: record.steps.len() as u32,
            held_steps: record.decisions().filter(|decision| decision.chosen.is_none()).count()
                as u32,
            malformed: candidates().filter(|candidate| candidate.malformed.is_some()).count()
                as u32,
            candidates: candidates().count() as u32,
            wall_secs: record.wall_secs,
            decision_ms: record.decisions().map(DecisionRecord::milliseconds).collect(),
            batch_size: record.decisions().map(|decision| decision.batch_size).collect(),
            step_ms: record.steps.iter().map(|step| step.step_ms).collect(),
            simulator_ms: record.steps.iter().map(|step| step.simulator_ms).collect(),
        }
    }
}
