//! The metadata of a verifier file: its policy, its training and its measured quality.
//!
//! The serde aliases are the names in files of the first format, which can still be read.

use anyhow::ensure;
use serde::{Deserialize, Serialize};

use crate::Metrics;

/// Dimensions of an action in files of the first format, which do not store it.
const ACTION_LENGTH_FIRST: usize = 7;

/// Everything in a verifier file except its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VerifierDescription {
    /// Digest of the policy whose hidden states the verifier reads.
    pub policy: String,
    /// Length of a hidden state.
    pub input_size: usize,
    /// Number of dimensions of the policy's actions.
    #[serde(default = "action_length_first")]
    pub action_length: usize,
    /// The training options.
    pub options: TrainingOptions,
    /// The training data.
    #[serde(alias = "evidence")]
    pub data: TrainingData,
    /// How well the network separates successes from failures of held-out episodes, for the
    /// executed candidates.
    pub held_out: Metrics,
    /// The data and the gain of the ranking; `None` if there is no ranking.
    #[serde(default, alias = "choice")]
    pub ranking: Option<RankingEvidence>,
}

fn action_length_first() -> usize {
    ACTION_LENGTH_FIRST
}

/// The data of the ranking and its cross-fitted gain: every episode is evaluated by models that
/// were fitted without its fold.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RankingEvidence {
    /// Episodes whose decisions had several candidates.
    pub episodes: usize,
    /// Number of their decisions.
    pub decisions: usize,
    /// Gain of the best-ranked candidate with a target factor of 1. A larger factor pays off only
    /// over many decisions.
    pub gain: ReRankingGain,
    /// Gain of the medoid, measured in the same way.
    pub medoid_gain: ReRankingGain,
}

/// Estimated gain from re-ranking single decisions: the sum over an episode's decisions of the
/// change if only that decision selected another candidate.
///
/// It compares rankings on the same episodes. It is not a forecast, because changes of several
/// decisions do not add up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReRankingGain {
    /// Gain in success rate in percentage points; the mean over the episodes.
    #[serde(alias = "points")]
    pub percentage_points: f64,
    /// Standard error of the mean; episodes with the same initial layout are one cluster.
    pub standard_error: f64,
}

/// The training options.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainingOptions {
    /// Seed of the split, the initial weights and the order of samples.
    pub seed: u64,
    /// Sizes of the two hidden layers.
    pub hidden_sizes: [usize; 2],
    /// Maximum number of passes over the training samples.
    pub epochs_max: usize,
    /// Training stops after this number of passes without a better validation loss.
    pub patience_epochs: usize,
    /// Samples per optimizer step.
    pub batch_samples: usize,
    /// Learning rate of AdamW.
    pub learning_rate: f64,
    /// Decoupled weight decay of AdamW.
    pub weight_decay: f64,
    /// Share of each task's initial layouts whose loss stops the training. 0 in files of the first
    /// format, whose training was stopped by the loss on the held-out episodes.
    #[serde(default)]
    pub validation_share: f64,
    /// Share of each task's initial layouts that is used neither for fitting nor for selection.
    pub held_out_share: f64,
    /// Whether to fit a ranking if there are enough episodes for it. Without a ranking this is the
    /// paper's verifier.
    #[serde(alias = "choice")]
    pub ranking: bool,
    /// TD(lambda)'s lambda: the weight of later changes of value in an action's advantage, per
    /// decision.
    pub advantage_decay: f64,
    /// Ridge penalty of the ranking's regression, in units of a standardised feature's variance.
    #[serde(alias = "choice_ridge")]
    pub ranking_ridge: f64,
    /// Factor of the weights for the distance to the target. The regression measures the effect of
    /// a single decision while later decisions drift; if every decision is guided, the effects
    /// accumulate.
    #[serde(alias = "aim_factor")]
    pub target_factor: f64,
}

impl TrainingOptions {
    /// Checks that the options are valid for training.
    pub fn check(&self) -> anyhow::Result<()> {
        let TrainingOptions { hidden_sizes, epochs_max, batch_samples, learning_rate, .. } = self;
        let TrainingOptions { validation_share, held_out_share, .. } = self;
        let TrainingOptions { advantage_decay, ranking_ridge, target_factor, .. } = self;
        ensure!(
            hidden_sizes.iter().all(|size| (1..=4096).contains(size)),
            "hidden sizes: expected 1 to 4096, got {hidden_sizes:?}"
        );
        ensure!((1..=10_000).contains(epochs_max), "epochs: expected 1 to 10000, got {epochs_max}");
        ensure!(*batch_samples > 0, "batch: expected at least 1 sample, got 0");
        ensure!(
            learning_rate.is_finite() && *learning_rate > 0.0,
            "learning rate: expected more than 0, got {learning_rate}"
        );
        for (name, share) in [("validation", validation_share), ("held-out", held_out_share)] {
            ensure!(
                *share > 0.0 && *share < 1.0,
                "{name} share: expected between 0 and 1, got {share}"
            );
        }
        ensure!(
            validation_share + held_out_share < 1.0,
            "validation and held-out share: expected a sum below 1, got {}",
            validation_share + held_out_share
        );
        ensure!(
            (0.0..=1.0).contains(advantage_decay),
            "advantage decay: expected 0 to 1, got {advantage_decay}"
        );
        ensure!(
            ranking_ridge.is_finite() && *ranking_ridge > 0.0,
            "ranking ridge: expected more than 0, got {ranking_ridge}"
        );
        ensure!(
            target_factor.is_finite() && *target_factor >= 0.0,
            "target factor: expected 0 or more, got {target_factor}"
        );
        Ok(())
    }
}

impl Default for TrainingOptions {
    fn default() -> TrainingOptions {
        TrainingOptions {
            seed: 0,
            hidden_sizes: [256, 64],
            epochs_max: 40,
            patience_epochs: 6,
            batch_samples: 256,
            learning_rate: 3e-4,
            weight_decay: 1e-2,
            validation_share: 0.1,
            held_out_share: 0.2,
            ranking: true,
            advantage_decay: 0.95,
            ranking_ridge: 0.12,
            target_factor: 4.0,
        }
    }
}

/// The training data of a verifier.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainingData {
    /// Number of episodes that the network was fitted to.
    pub training_episodes: usize,
    /// Number of successes among them.
    pub training_successes: usize,
    /// Number of their control steps with a hidden state.
    pub training_samples: usize,
    /// Number of episodes that determined when training stopped.
    pub validation_episodes: usize,
    /// Number of successes among them.
    pub validation_successes: usize,
    /// Number of their control steps with a hidden state.
    pub validation_samples: usize,
    /// Number of held-out episodes.
    pub held_out_episodes: usize,
    /// Number of successes among them.
    pub held_out_successes: usize,
    /// Number of their control steps with a hidden state.
    pub held_out_samples: usize,
    /// Number of passes up to the weights that were kept.
    pub epochs: usize,
}
