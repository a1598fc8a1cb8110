//! The seam for scorers: a learned verifier, a judge model, a script.

use anyhow::Result;
use async_trait::async_trait;
use protocol::message::Image;

use crate::{ActionSpace, Candidate, TrackedObjects};

/// The candidates of one decision, with all that a scorer may look at.
#[derive(Clone, Copy, Debug)]
pub struct ScoringRequest<'a> {
    /// What the policy saw.
    pub image: &'a Image,
    /// What the robot felt, as the task's description says.
    pub state: &'a [f32],
    /// What the robot was told.
    pub instruction: &'a str,
    /// In the order of their streams; at least one, some of them malformed.
    pub candidates: &'a [Candidate],
    /// Where the reasoning of this episode, these candidates' included, sees the objects.
    pub tracked: TrackedObjects,
    /// How the candidates' actions compare.
    pub action_space: &'a ActionSpace,
}

/// Scores candidates. An error is a fault of the one episode whose request failed.
#[async_trait]
pub trait Scorer: Send + Sync {
    /// What it computes, in hexadecimal: scorers with one digest give the same scores.
    fn digest(&self) -> &str;

    /// The logit of each candidate of each request; that of a malformed candidate means nothing.
    ///
    /// Logits, not probabilities: probabilities near 1 are equal in 32 bits long before the logits are.
    async fn score(&self, requests: &[ScoringRequest<'_>]) -> Vec<Result<Vec<f32>>>;
}

/// The probability that belongs to a logit.
pub fn probability(logit: f32) -> f32 {
    (1.0 / (1.0 + (-f64::from(logit)).exp())) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn probabilities_are_right_far_from_zero() {
        assert_eq!(probability(0.0), 0.5);
        assert_eq!(probability(100.0), 1.0);
        assert!(probability(-100.0) > 0.0 && probability(-100.0) < 1e-40);
        assert_eq!(probability(-1000.0), 0.0);
        assert!((f64::from(probability(1.5)) - 0.817_574_476).abs() < 1e-7);
    }
}
