//! Which of several candidates is better, as outcomes have shown.
//!
//! The score of a hidden state mostly says how promising the situation is, which is the same for all candidates of one
//! decision. This part looks only at what differs between them: how sure the policy was of each part of the reasoning and
//! of the action, and how far the action is from those of its siblings. It is linear, because one action changes an
//! episode's outcome by little and only few numbers can be learnt from that.

use std::ops::Range;

use anyhow::ensure;

use crate::policy::{Confidence, PARTS};
use crate::strategy::{CandidateAction, distance_mean};

/// Numbers of an action.
const NUMBERS: usize = 7;
/// Log-probabilities of the parts, sizes of the deviations, and the nearness to the siblings.
pub const FEATURES: usize = PARTS + NUMBERS + 1;

/// Features of which more is never better: the sizes of the deviations. Of all others less is never better.
pub const PENALTIES: Range<usize> = PARTS..PARTS + NUMBERS;

/// How one candidate differs from its siblings; every feature's mean over the siblings is 0.
pub type Features = [f32; FEATURES];

/// A well-formed candidate beside others.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sibling {
    /// What it would do.
    pub action: CandidateAction,
    /// How sure the policy was of its parts.
    pub confidence: Confidence,
}

/// The learnt weights: the change of the probability of success per unit of each feature.
#[derive(Clone, Debug, PartialEq)]
pub struct Choice {
    weights: Features,
}

impl Choice {
    /// Refuses weights that are not numbers.
    pub fn new(weights: Features) -> anyhow::Result<Choice> {
        ensure!(
            weights.iter().all(|weight| weight.is_finite()),
            "choice weights: expected finite values, got NaN or infinity"
        );
        Ok(Choice { weights })
    }

    /// One for each feature.
    pub fn weights(&self) -> &Features {
        &self.weights
    }

    /// The change of the probability of success that a candidate brings, against the mean of its siblings.
    pub fn advantage(&self, features: &Features) -> f32 {
        self.weights.iter().zip(features).map(|(weight, value)| weight * value).sum()
    }
}

/// The features of every well-formed candidate; `action_scale` is one unit of each number of an action.
///
/// Deviations are those from the mean action, without their sign: whoever always leans to the better side leaves the
/// states in which that side was seen to be better. A number without range cannot tell candidates apart and deviates by 0.
pub fn features(
    siblings: &[Option<Sibling>],
    action_scale: &[f32; NUMBERS],
) -> Vec<Option<Features>> {
    let candidates: Vec<Option<CandidateAction>> =
        siblings.iter().map(|sibling| sibling.as_ref().map(|sibling| sibling.action)).collect();
    let scaled = |candidate: &CandidateAction| -> [f32; NUMBERS] {
        std::array::from_fn(|index| {
            let scale = action_scale[index];
            if scale > 0.0 { candidate.action[index] / scale } else { 0.0 }
        })
    };
    let action_mean: [f32; NUMBERS] =
        mean(&candidates.iter().flatten().map(scaled).collect::<Vec<_>>());
    let raw = siblings.iter().enumerate().map(|(index, sibling)| {
        let Sibling { action, confidence } = sibling.as_ref()?;
        let mut features = [0.0; FEATURES];
        let (parts, deviations) = features.split_at_mut(PARTS);
        parts.copy_from_slice(confidence);
        for (number, value) in scaled(action).iter().enumerate() {
            deviations[number] = (value - action_mean[number]).abs();
        }
        deviations[NUMBERS] = -distance_mean(&candidates, index, action) as f32;
        Some(features)
    });
    let raw: Vec<Option<Features>> = raw.collect();
    let features_mean: Features = mean(&raw.iter().flatten().copied().collect::<Vec<_>>());
    let centre = |row: Features| std::array::from_fn(|index| row[index] - features_mean[index]);
    raw.into_iter().map(|row| row.map(centre)).collect()
}

/// The mean of rows; zeros when there is none.
fn mean<const SIZE: usize>(rows: &[[f32; SIZE]]) -> [f32; SIZE] {
    let mut sum = [0.0; SIZE];
    for row in rows {
        sum.iter_mut().zip(row).for_each(|(sum, value)| *sum += value);
    }
    sum.map(|sum| sum / rows.len().max(1) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCALE: [f32; 7] = [0.1, 0.1, 0.1, 0.0, 0.1, 0.1, 2.0];

    fn at(x: f32, bin: u32, gripper: f32) -> Option<Sibling> {
        let tokens = [bin, 500, 500, 500, 500, 500, if gripper > 0.0 { 599 } else { 400 }];
        let action = CandidateAction { tokens, action: [x, 0.0, 0.0, 9.0, 0.0, 0.0, gripper] };
        let mut confidence = [0.0; PARTS];
        confidence[2] = -10.0 * x;
        Some(Sibling { action, confidence })
    }

    #[test]
    fn features_are_relative_to_the_siblings() {
        let candidates = [at(0.1, 500, 1.0), None, at(0.3, 551, 1.0), at(0.2, 500, -1.0)];
        let rows = features(&candidates, &SCALE);
        assert!(rows[1].is_none());
        let rows: Vec<Features> = rows.into_iter().flatten().collect();
        let check = |index: usize, expected: [f32; 3]| {
            let found = [rows[0][index], rows[1][index], rows[2][index]];
            let near = found.iter().zip(expected).all(|(found, one)| (found - one).abs() < 1e-5);
            assert!(near, "feature {index}: expected {expected:?}, got {found:?}");
        };
        // Log-probabilities -1, -3 and -2.
        check(2, [1.0, -1.0, 0.0]);
        // x deviates by 1, 1 and 0 units of 0.1; their mean is 2/3.
        check(PARTS, [1.0 / 3.0, 1.0 / 3.0, -2.0 / 3.0]);
        // Roll has no range here.
        check(PARTS + 3, [0.0; 3]);
        // The gripper, of which one unit is 2: two open, one closed, the mean at 1/3.
        check(PARTS + 6, [-1.0 / 9.0, -1.0 / 9.0, 2.0 / 9.0]);
        // Mean distances 0.6, 0.7 and 1.1 (51 bins are a fifth of the range, the other gripper side is 1).
        check(PARTS + 7, [0.2, 0.1, -0.3]);
    }

    #[test]
    fn a_lone_candidate_has_no_advantage() {
        let choice = Choice::new([3.0; FEATURES]).expect("finite");
        let rows = features(&[None, at(0.3, 551, -1.0)], &SCALE);
        assert_eq!(choice.advantage(&rows[1].expect("well formed")), 0.0);
        assert!(features(&[None, None], &SCALE).iter().all(Option::is_none));
        assert!(Choice::new([f32::NAN; FEATURES]).is_err());
    }
}
