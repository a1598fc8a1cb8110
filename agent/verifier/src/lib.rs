//! The learned scorer: says how likely the episode succeeds if a candidate is executed.
//!
//! ```text
//! last hidden states ─▶ mean ─▶ network (equation 4): how promising the situation is ─────────────┐
//! confidence, actions ─▶ against the siblings ─▶ ranking: which candidate is better ──────────────┴▶ logit of each
//! where the reasoning sees the objects ─▶ target model: where the gripper should go ─┘
//! ```

mod description;
mod file;
mod metrics;
mod network;
mod ranking;
mod target;
mod verifier;

pub mod training;
