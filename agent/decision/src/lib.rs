//! What one control step is made of, without a network, a disk or a clock.
//!
//! ```text
//! Observation ─▶ Policy::propose ─▶ Candidates ─▶ Scorer::score ─▶ Strategy::choose ─▶ ActionChunk
//!                └────────────────────────── Decider::decide ──────────────────────────┘
//! ```
//!
//! [`Decider`] makes these calls for a batch of episodes, each with an [`EpisodeContext`] of its own. Rollouts, the
//! benchmark and the tests all use it. A failure of the policy or of a scorer is a fault of the episode that it
//! happened in, never an outcome.

// What is seen and done.
mod action;
mod task;

// What a policy proposes.
mod candidate;
mod policy;
mod reasoning;

// How one candidate is chosen.
mod scorer;
mod setting;
mod strategy;
mod tracker;

// All of it together.
mod context;
mod decider;

#[cfg(any(test, feature = "scripted"))]
pub mod scripted;

pub use action::{Action, ActionChunk, ActionSpace};
pub use candidate::{Candidate, CandidateAction, Parsed, Proposal, ProposalRequest};
pub use context::{EpisodeContext, step_seed};
pub use decider::{Decider, Decision, DecisionFault, DecisionRequest};
pub use policy::{Policy, PolicyInfo};
pub use protocol::message::{Image, Observation};
pub use reasoning::{Malformed, Reasoning, TAGS, VisibleObject, last_tag};
pub use scorer::{Scorer, ScoringRequest, probability};
pub use setting::Setting;
pub use strategy::{
    Alternatives, MAJORITY_TOLERANCE_BINS, MEDOID_WEIGHT_LOGITS, Strategy, UnknownStrategy,
    distance_mean,
};
pub use task::{TaskId, VARIANT_DEFAULT};
pub use tracker::{BoundingBox, ObjectTracker, ReasoningFeatures, STAGES, Stage, TrackedObjects};
