//! Which of several candidates is better, as outcomes have shown.
//!
//! The score of a hidden state mostly says how promising the situation is, which is the same for all candidates of one
//! decision. This part looks only at what differs between them: how sure the policy was of each part of the reasoning and
//! of the action, how far the action is from those of its siblings, and how near it brings the gripper to where all the
//! words so far say that it should go. It is linear, because one action changes an
//! episode's outcome by little and only few numbers can be learnt from that.

use std::ops::Range;

use anyhow::ensure;

use super::aim::{TargetModel, STAGES, Target, ReasoningFeatures};
use vla::{Confidence, PARTS};
use decision::{CandidateAction, distance_mean};

/// Numbers of an action.
const NUMBERS: usize = 7;
/// The nearness to the siblings, whose largest is the medoid's.
pub const NEARNESS: usize = PARTS + NUMBERS;
/// The nearness to the target, one for each stage.
pub const AIM: Range<usize> = NEARNESS + 1..NEARNESS + 1 + STAGES;
/// Log-probabilities of the parts, sizes of the deviations, nearness to the siblings and to the target.
pub const FEATURES: usize = AIM.end;

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
    /// Where it sees what; none when it does not say.
    pub words: Option<ReasoningFeatures>,
}

/// What has been learnt of choosing.
#[derive(Clone, Debug, PartialEq)]
pub struct Choice {
    /// The change of the probability of success per unit of each feature.
    weights: Features,
    target_model: TargetModel,
}

impl Choice {
    /// Refuses weights that are not numbers.
    pub fn new(weights: Features, target_model: TargetModel) -> anyhow::Result<Choice> {
        ensure!(
            weights.iter().all(|weight| weight.is_finite()),
            "choice weights: expected finite values, got NaN or infinity"
        );
        Ok(Choice { weights, target_model })
    }

    /// One for each feature.
    pub fn weights(&self) -> &Features {
        &self.weights
    }

    /// Where the gripper should go.
    pub fn target_model(&self) -> &TargetModel {
        &self.target_model
    }

    /// The change of the probability of success that a candidate brings, against the mean of its siblings.
    pub fn advantage(&self, features: &Features) -> f32 {
        self.weights.iter().zip(features).map(|(weight, value)| weight * value).sum()
    }
}

/// The same features with another target; `actions` are those of the candidates.
pub fn retarget(features: &mut [Features], actions: &[[f32; NUMBERS]], target: Option<Target>) {
    let near = |target: Target| actions.iter().map(move |action| -target.distance(action));
    let mean = target.map_or(0.0, |target| near(target).sum::<f32>() / actions.len() as f32);
    for (features, action) in features.iter_mut().zip(actions) {
        features[AIM].fill(0.0);
        if let Some(target) = target {
            features[AIM.start + target.stage as usize] = -target.distance(action) - mean;
        }
    }
}

/// The features of every well-formed candidate; `action_scale` is one unit of each number of an action.
///
/// Deviations are those from the mean action, without their sign: whoever always leans to the better side leaves the
/// states in which that side was seen to be better. A number without range cannot tell candidates apart and deviates by 0.
pub fn features(
    siblings: &[Option<Sibling>],
    action_scale: &[f32; NUMBERS],
    target: Option<Target>,
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
        let Sibling { action, confidence, .. } = sibling.as_ref()?;
        let mut features = [0.0; FEATURES];
        let (parts, deviations) = features.split_at_mut(PARTS);
        parts.copy_from_slice(confidence);
        for (number, value) in scaled(action).iter().enumerate() {
            deviations[number] = (value - action_mean[number]).abs();
        }
        features[NEARNESS] = -distance_mean(&candidates, index, action) as f32;
        if let Some(target) = target {
            features[AIM.start + target.stage as usize] = -target.distance(&action.action);
        }
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
    use decision::Stage;

    const SCALE: [f32; 7] = [0.1, 0.1, 0.1, 0.0, 0.1, 0.1, 2.0];

    fn at(x: f32, bin: u32, gripper: f32) -> Option<Sibling> {
        let tokens = [bin, 500, 500, 500, 500, 500, if gripper > 0.0 { 599 } else { 400 }];
        let action = CandidateAction { tokens, action: [x, 0.0, 0.0, 9.0, 0.0, 0.0, gripper] };
        let mut confidence = [0.0; PARTS];
        confidence[2] = -10.0 * x;
        Some(Sibling { action, confidence, words: None })
    }

    #[test]
    fn features_are_relative_to_the_siblings() {
        let candidates = [at(0.1, 500, 1.0), None, at(0.3, 551, 1.0), at(0.2, 500, -1.0)];
        let target = Target { stage: Stage::Place, offset: [0.2, 0.0] };
        let rows = features(&candidates, &SCALE, Some(target));
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
        // Nothing is grasped; 10, 10 and 0 cm from the place.
        check(AIM.start, [0.0; 3]);
        check(AIM.start + 1, [-0.1 / 3.0, -0.1 / 3.0, 0.2 / 3.0]);
        let plain = features(&candidates, &SCALE, None).into_iter().flatten();
        let mut plain: Vec<Features> = plain.collect();
        assert_eq!(plain[2][AIM.start + 1], 0.0);
        let actions: Vec<_> = candidates.iter().flatten().map(|one| one.action.action).collect();
        retarget(&mut plain, &actions, Some(target));
        let pairs = plain.as_flattened().iter().zip(rows.as_flattened());
        assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 1e-6));
        retarget(&mut plain, &actions, None);
        assert_eq!(plain[2][AIM.start + 1], 0.0);
    }

    #[test]
    fn a_lone_candidate_has_no_advantage() {
        let choice = Choice::new([3.0; FEATURES], TargetModel::default()).expect("finite");
        let rows = features(&[None, at(0.3, 551, -1.0)], &SCALE, None);
        assert_eq!(choice.advantage(&rows[1].expect("well formed")), 0.0);
        assert!(features(&[None, None], &SCALE, None).iter().all(Option::is_none));
        assert!(Choice::new([f32::NAN; FEATURES], TargetModel::default()).is_err());
    }
}
