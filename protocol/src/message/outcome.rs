//! The outcome of one episode, published for observers.

use serde::{Deserialize, Serialize};

use super::{Statistics, strict, value};
use crate::codec::Message;
use crate::limits::{OUTCOME_BYTES_MAX, SEED_END};

/// Published once for each episode that reached its end; an episode that ended in a fault has none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeOutcome {
    /// The run that the episode belongs to.
    pub run: String,
    /// Name of the task in the server's description.
    pub task: String,
    /// `default`, or the name of what is changed.
    pub variant: String,
    /// Number of the fixed initial layout; `None` for a random layout.
    #[serde(deserialize_with = "strict::optional")]
    pub layout: Option<u32>,
    /// Seed of the layout.
    pub seed: u64,
    /// Number of the episode within its task and variant.
    pub episode: u32,
    /// The strategy that selected the candidates.
    pub strategy: String,
    /// Candidates per step.
    pub candidates: u32,
    /// Sampling temperature.
    #[serde(deserialize_with = "strict::float")]
    pub temperature: f32,
    /// Digest of the policy's weights.
    pub policy: String,
    /// Digest of the verifier's weights, if the strategy used one.
    #[serde(deserialize_with = "strict::optional")]
    pub verifier: Option<String>,
    /// The statistics at the last step.
    pub statistics: Statistics,
    /// Number of control steps.
    pub steps: u32,
    /// Mean score of the executed candidates, if a verifier scored them.
    #[serde(deserialize_with = "strict::optional_float")]
    pub score_mean: Option<f32>,
    /// The simulator and its version.
    pub simulator: String,
}

impl Message for EpisodeOutcome {
    const NAME: &'static str = "outcome";
    const BYTES_MAX: usize = OUTCOME_BYTES_MAX;

    fn validate(&self) -> Result<(), String> {
        value::name("run", &self.run)?;
        value::name("task", &self.task)?;
        value::name("variant", &self.variant)?;
        value::range("seed", self.seed, 0, SEED_END - 1)?;
        value::name("strategy", &self.strategy)?;
        value::finite("temperature", &[self.temperature])?;
        value::name("policy", &self.policy)?;
        self.verifier.as_ref().map_or(Ok(()), |verifier| value::name("verifier", verifier))?;
        self.score_mean.map_or(Ok(()), |score| value::finite("score_mean", &[score]))?;
        value::text("simulator", &self.simulator)
    }
}
