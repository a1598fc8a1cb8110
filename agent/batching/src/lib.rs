//! Decisions of many concurrent episodes in shared batches.
//!
//! ```text
//! episode ─▶ DecisionBatcher ─▶ Decider::decide for all that are ready ─▶ Answer
//! ```
//!
//! Rollouts and the policy server use the same batcher. A decision does not depend on the other
//! episodes of its batch.

mod batcher;

pub use batcher::{Active, Answer, DecisionBatcher};
