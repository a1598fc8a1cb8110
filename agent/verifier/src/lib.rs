//! The learned scorer: how likely the episode is to succeed if a candidate is executed.
//!
//! ```text
//! last hidden states ─▶ mean ─▶ network (equation 4): how promising the situation is ─────────────────┐
//! confidence, actions ─▶ against the other candidates ─▶ ranking: which candidate is better ──────────┴▶ a logit each
//! objects in the reasoning ─▶ target model: where the gripper should go ─▶ ranking
//! ```
//!
//! [`Verifier`] is a [`decision::Scorer`]; [`training`] makes one from the records of finished episodes.

// What scores.
mod verifier;

mod network;
mod ranking;
mod target;

// Why it scored so.
mod explanation;

// What is kept.
mod description;
mod file;

// How it is made and judged.
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
