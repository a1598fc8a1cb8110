//! The learned verifier: predicts how likely an episode is to succeed if a candidate is executed.
//!
//! ```text
//! last hidden states ─▶ mean ─▶ network (equation 4): value of the situation ──────┐
//! confidence, actions ─▶ relative to the others ─▶ ranking: candidate's advantage ─┴▶ logits
//! objects in the reasoning ─▶ target model: where the gripper should go ─▶ ranking
//! ```
//!
//! [`Verifier`] implements [`decision::Scorer`]; [`training`] trains one from the records of
//! finished episodes.

// Scoring.
mod verifier;

mod network;
mod ranking;
mod target;

// Explanations of scores.
mod explanation;

// The file format.
mod description;
mod file;

// Training and evaluation.
mod metrics;
pub mod training;

pub use description::{
    RankingEvidence, ReRankingGain, TrainingData, TrainingOptions, VerifierDescription,
};
pub use explanation::{DecisionTerms, explain, term_names};
pub use metrics::{Discrimination, Metrics, PHASE_STEPS, ScoredSamples, weighted_loss};
pub use network::{Layer, Network, Standardisation};
pub use ranking::{CandidateFeatures, FeatureLayout, Ranking};
pub use target::{PredictedTarget, TERMS, TargetMap, TargetModel, terms};
pub use verifier::{FILE_BYTES_MAX, LOGITS_PER_PROBABILITY, Verifier, mean_hidden};
