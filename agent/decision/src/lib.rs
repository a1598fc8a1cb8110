//! One control step, without network, disk or clock.
//!
//! ```text
//! Observation ─▶ Policy::propose ─▶ Candidates ─▶ Scorer::score ─▶ Strategy::choose ─▶ ActionChunk
//!                └────────────────────────── Decider::decide ──────────────────────────┘
//! ```
//!
//! [`Decider`] makes these calls for a batch of episodes, each with its own [`EpisodeContext`].
//! Rollouts, the benchmark and the tests use it. A failure of the policy or of a scorer is a fault
//! of the episode in which it occurred, never an outcome.

// Tasks, actions and seeds.
mod action;
mod rotation;
mod seeds;
mod task;

// Proposals of a policy.
mod candidate;
mod fit;
mod policy;
mod reasoning;

// Choosing one candidate.
mod scorer;
mod setting;
mod strategy;
mod tracker;

// The complete decision.
mod context;
mod decider;
mod episode;

#[cfg(any(test, feature = "scripted"))]
pub mod scripted;

pub use action::{Action, ActionChunk, ActionSpace};
pub use candidate::{Candidate, CandidateAction, Parsed, Proposal, ProposalRequest};
pub use context::{EpisodeContext, step_seed};
pub use decider::{Decider, Decision, DecisionFault, DecisionRequest};
pub use episode::{EpisodeName, EpisodeToken, EpisodeWatch};
pub use fit::fit_image;
pub use policy::{Policy, PolicyInfo};
pub use protocol::message::{Image, Observation};
pub use reasoning::{Malformed, Reasoning, TAGS, Unread, VisibleObject, last_tag};
pub use rotation::{quaternion, roll_pitch_yaw, rotation_vector};
pub use scorer::{Scorer, ScoringRequest, probability};
pub use seeds::{episode_hash, episode_name, sampling_seed};
pub use setting::Setting;
pub use strategy::{
    Alternatives, MAJORITY_TOLERANCE_BINS, MEDOID_WEIGHT_LOGITS, Strategy, UnknownStrategy,
    distance_mean,
};
pub use task::{TaskId, VARIANT_DEFAULT};
pub use tracker::{BoundingBox, ObjectTracker, ReasoningFeatures, STAGES, Stage, TrackedObjects};
