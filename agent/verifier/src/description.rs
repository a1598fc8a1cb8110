//! What a verifier file says about itself: for which policy, trained how and on what, and how good it is.
//!
//! The aliases are the names in files of the first format, which stay readable.

use anyhow::ensure;
use serde::{Deserialize, Serialize};

use crate::Metrics;

/// Numbers of an action in files of the first format, which do not say it.
const ACTION_LENGTH_FIRST: usize = 7;

/// Everything in a verifier file beside its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VerifierDescription {
    /// Digest of the policy whose hidden states it reads.
    pub policy: String,
    /// Length of a hidden state.
    pub input_size: usize,
    /// Numbers of the policy's actions.
    #[serde(default = "action_length_first")]
    pub action_length: usize,
    /// How it was trained.
    pub options: TrainingOptions,
    /// What it was trained on.
    #[serde(alias = "evidence")]
    pub data: TrainingData,
    /// How well its network separates successes from failures on the held-out episodes, by executed candidates.
    pub held_out: Metrics,
    /// What its ranking was fitted to; none when it has no ranking.
    #[serde(default, alias = "choice")]
    pub ranking: Option<RankingEvidence>,
}

fn action_length_first() -> usize {
    ACTION_LENGTH_FIRST
}

/// What the ranking was fitted to, and its cross-fitted gain: no model that an episode is judged with has seen an episode
/// of its fold.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RankingEvidence {
    /// Episodes whose decisions had several candidates.
    pub episodes: usize,
    /// Their decisions.
    pub decisions: usize,
    /// Gain of the best-ranked candidate, with a target factor of 1: a larger one pays only over many decisions.
    pub gain: ReRankingGain,
    /// Gain of the medoid, by the same measure.
    pub medoid_gain: ReRankingGain,
}

/// Estimated gain from re-ranking single decisions: the sum, over an episode's decisions, of what choosing another
/// candidate in that decision alone would change.
///
/// It compares rankings on the same episodes. It is no forecast: changes of many decisions do not add up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReRankingGain {
    /// Percentage points of success, mean of the episodes.
    #[serde(alias = "points")]
    pub percentage_points: f64,
    /// Of that mean; episodes of one initial layout count as one cluster.
    pub standard_error: f64,
}

/// How a verifier is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainingOptions {
    /// Seed of the split, the first weights and the order of samples.
    pub seed: u64,
    /// Sizes of the two hidden layers.
    pub hidden_sizes: [usize; 2],
    /// Passes over the training samples at most.
    pub epochs_max: usize,
    /// Passes without a better validation loss after which training stops.
    pub patience_epochs: usize,
    /// Samples per step of the optimizer.
    pub batch_samples: usize,
    /// Step size of AdamW.
    pub learning_rate: f64,
    /// Decoupled weight decay of AdamW.
    pub weight_decay: f64,
    /// Share of the initial layouts of every task that decides when training stops. 0 in files of the first format,
    /// whose training stopped by the loss on the held-out episodes.
    #[serde(default)]
    pub validation_share: f64,
    /// Share of the initial layouts of every task that nothing is fitted to or chosen by.
    pub held_out_share: f64,
    /// Whether to fit a ranking where there are episodes for it; without one this is the paper's verifier.
    #[serde(alias = "choice")]
    pub ranking: bool,
    /// Share of each later change of value that counts for an action's advantage, per decision: TD(lambda)'s lambda.
    pub advantage_decay: f64,
    /// Ridge of the ranking's regression, in units of a standardised feature's variance.
    #[serde(alias = "choice_ridge")]
    pub ranking_ridge: f64,
    /// What the weights of the nearness to the target are multiplied by. The regression sees what one decision does
    /// while all later ones drift on; a gripper that is led by every decision keeps what it has gained.
    #[serde(alias = "aim_factor")]
    pub target_factor: f64,
}

impl TrainingOptions {
    /// Refuses options that no training can follow.
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
            "validation and held-out share: expected less than 1 together, got {}",
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

/// What a verifier was trained on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainingData {
    /// Episodes that the network was fitted to.
    pub training_episodes: usize,
    /// How many of them succeeded.
    pub training_successes: usize,
    /// Their control steps with a hidden state.
    pub training_samples: usize,
    /// Episodes that decided when training stopped.
    pub validation_episodes: usize,
    /// How many of them succeeded.
    pub validation_successes: usize,
    /// Their control steps with a hidden state.
    pub validation_samples: usize,
    /// Episodes held out.
    pub held_out_episodes: usize,
    /// How many of them succeeded.
    pub held_out_successes: usize,
    /// Their control steps with a hidden state.
    pub held_out_samples: usize,
    /// Passes over the training samples until the weights that were kept.
    pub epochs: usize,
}
