//! The interface of scorers: a learned verifier, a judge model, a script.

use anyhow::Result;
use async_trait::async_trait;
use protocol::message::Image;

use crate::{ActionSpace, Candidate, TrackedObjects};

/// The candidates of one decision, with everything that a scorer may use.
#[derive(Clone, Copy, Debug)]
pub struct ScoringRequest<'a> {
    /// The policy's input image.
    pub image: &'a Image,
    /// The robot's state, with the dimensions in the task's description.
    pub state: &'a [f32],
    /// The language instruction for the robot.
    pub instruction: &'a str,
    /// In the order of their random streams; at least one. Some may be malformed.
    pub candidates: &'a [Candidate],
    /// Object positions according to the reasoning of this episode, including these candidates.
    pub tracked: TrackedObjects,
    /// How to compare the candidates' actions.
    pub action_space: &'a ActionSpace,
}

/// Scores candidates. An error is a fault of only that episode whose request failed.
#[async_trait]
pub trait Scorer: Send + Sync {
    /// Identity of the computation, in hexadecimal: scorers with the same digest give the same
    /// scores.
    fn digest(&self) -> &str;

    /// The logits of each request's candidates; the logit of a malformed candidate has no meaning.
    ///
    /// These are logits because probabilities near 1 become equal in 32 bits while their logits
    /// still differ.
    async fn score(&self, requests: &[ScoringRequest<'_>]) -> Vec<Result<Vec<f32>>>;
}

/// The probability of a logit (sigmoid).
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
