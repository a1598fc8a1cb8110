//! What a verifier file says about itself: for which policy, trained how and on what, and how good it is.

use serde::{Deserialize, Serialize};

use super::Metrics;

/// Everything in a verifier file beside its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// Digest of the policy whose hidden states it reads.
    pub policy: String,
    /// Length of a hidden state.
    pub input_size: usize,
    /// How it was trained.
    pub options: Options,
    /// What it was trained on.
    pub evidence: Evidence,
    /// How well its network separates successes from failures on the held-out episodes, by executed candidates.
    pub held_out: Metrics,
    /// What its choice part was trained on; none when it has none.
    #[serde(default)]
    pub choice: Option<ChoiceEvidence>,
}

/// What the choice part was trained on, and what it is worth by the same episodes, cross-fitted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChoiceEvidence {
    /// Sampled episodes whose decisions had several candidates.
    pub episodes: usize,
    /// Their decisions.
    pub decisions: usize,
    /// Of choosing the best candidate, with an aim factor of 1: a larger one pays only over many decisions.
    pub gain: Gain,
    /// Of choosing the medoid, by the same measure.
    pub medoid_gain: Gain,
}

/// The sum, over an episode's decisions, of what choosing in that decision alone would change.
///
/// It compares ways to choose on the same episodes. It is no forecast: changes of many decisions do not add up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Gain {
    /// Percentage points of success, mean of the episodes.
    pub points: f64,
    /// Of that mean.
    pub standard_error: f64,
}

/// How a verifier is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Options {
    /// Seed of the split, the first weights and the order of samples.
    pub seed: u64,
    /// Sizes of the two hidden layers.
    pub hidden_sizes: [usize; 2],
    /// Passes over the training samples at most.
    pub epochs_max: usize,
    /// Passes without a better held-out loss after which training stops.
    pub patience_epochs: usize,
    /// Samples per step of the optimiser.
    pub batch_samples: usize,
    /// Step size of AdamW.
    pub learning_rate: f64,
    /// Decoupled weight decay of AdamW.
    pub weight_decay: f64,
    /// Share of the episodes of every task that are held out.
    pub held_out_share: f64,
    /// Whether to fit a choice part when there are episodes for it; without one this is the paper's verifier.
    pub choice: bool,
    /// Share of each later change of value that counts for an action's advantage, per control step: TD(lambda)'s lambda.
    pub advantage_decay: f64,
    /// Ridge of the choice part's regression, in units of a standardised feature's variance.
    pub choice_ridge: f64,
    /// What the weights of the nearness to the target are multiplied by. The regression sees what one decision does
    /// while all later ones drift on; a gripper that is led by every decision keeps what it has gained.
    pub aim_factor: f64,
}

impl Default for Options {
    fn default() -> Options {
        Options {
            seed: 0,
            hidden_sizes: [256, 64],
            epochs_max: 40,
            patience_epochs: 6,
            batch_samples: 256,
            learning_rate: 3e-4,
            weight_decay: 1e-2,
            held_out_share: 0.2,
            choice: true,
            advantage_decay: 0.95,
            choice_ridge: 0.12,
            aim_factor: 4.0,
        }
    }
}

/// What a verifier was trained on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Evidence {
    /// Episodes that the weights were fitted to.
    pub training_episodes: usize,
    /// How many of them succeeded.
    pub training_successes: usize,
    /// Their control steps with a hidden state.
    pub training_samples: usize,
    /// Episodes held out.
    pub held_out_episodes: usize,
    /// How many of them succeeded.
    pub held_out_successes: usize,
    /// Their control steps with a hidden state.
    pub held_out_samples: usize,
    /// Passes over the training samples until the weights that were kept.
    pub epochs: usize,
}
