//! The ranking of candidates, learned from outcomes.
//!
//! The network's score mostly describes the situation, which is the same for all candidates of a
//! decision. The ranking uses only what differs between them: the policy's confidence in each part
//! of reasoning and action, the distance of the action from the other candidates' actions, and the
//! distance of the gripper from its target. It is linear, because a single action changes the
//! outcome of an episode only slightly, so that few parameters can be learned.

use std::ops::Range;

use anyhow::ensure;
use decision::{ActionChunk, ActionSpace, Candidate, CandidateAction, STAGES, TAGS, distance_mean};

use crate::target::{PredictedTarget, TargetModel};

/// Maximum absolute weight: features are of the order of 1, and a probability changes by at most 1.
const WEIGHT_MAX: f32 = 1e6;

/// The indices of a candidate's features; their number depends on the policy's actions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FeatureLayout {
    /// Number of dimensions of an action.
    pub action_length: usize,
}

impl FeatureLayout {
    /// Log-probabilities of the parts of the reasoning and of the dimensions of the action.
    pub fn confidence(self) -> Range<usize> {
        0..TAGS.len() + self.action_length
    }

    /// Distance of each dimension of the action from the candidates' mean. Their weights are never
    /// positive; the weights of all other features are never negative.
    pub fn deviations(self) -> Range<usize> {
        let start = self.confidence().end;
        start..start + self.action_length
    }

    /// Negative mean distance to the other candidates; largest for the medoid.
    pub fn nearness(self) -> usize {
        self.deviations().end
    }

    /// Negative distance to the target, one per stage.
    pub fn target(self) -> Range<usize> {
        let start = self.nearness() + 1;
        start..start + STAGES
    }

    /// Number of features.
    pub fn length(self) -> usize {
        self.target().end
    }
}

/// A fitted ranking.
#[derive(Clone, Debug, PartialEq)]
pub struct Ranking {
    layout: FeatureLayout,
    /// Change of the success probability per unit of each feature.
    weights: Vec<f32>,
    target_model: TargetModel,
}

impl Ranking {
    /// Checks that the weights are as many as the features, finite and not too large.
    pub fn new(
        layout: FeatureLayout,
        weights: Vec<f32>,
        target_model: TargetModel,
    ) -> anyhow::Result<Ranking> {
        let (expected, got) = (layout.length(), weights.len());
        ensure!(got == expected, "ranking weights: expected {expected} values, got {got}");
        for weight in &weights {
            ensure!(
                weight.abs() <= WEIGHT_MAX,
                "ranking weights: expected at most {WEIGHT_MAX}, got {weight}"
            );
        }
        Ok(Ranking { layout, weights, target_model })
    }

    /// The meaning of the weights.
    pub fn layout(&self) -> FeatureLayout {
        self.layout
    }

    /// One weight per feature.
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// The model of the gripper's target.
    pub fn target_model(&self) -> &TargetModel {
        &self.target_model
    }

    /// The change of the success probability by a candidate, relative to the mean of all
    /// candidates.
    pub fn advantage(&self, features: &[f32]) -> f32 {
        self.weights.iter().zip(features).map(|(weight, value)| weight * value).sum()
    }
}

/// The features of the well-formed candidates of one decision, one row each. Every feature has mean
/// 0.
#[derive(Clone, Debug, PartialEq)]
pub struct CandidateFeatures {
    layout: FeatureLayout,
    rows: Vec<Vec<f32>>,
    /// The gripper's motion by each candidate: x and y in the base frame, in metres.
    motions: Vec<[f32; 2]>,
}

impl CandidateFeatures {
    /// Computes the features without a target. Refuses candidates that do not have the policy's
    /// parts and dimensions.
    ///
    /// Deviations from the mean action have no sign: a ranking that always prefers one direction
    /// leaves the states in which that direction was better. A dimension without a range has
    /// deviation 0. A chunk is represented by its mean action.
    pub fn of(candidates: &[Candidate], space: &ActionSpace) -> anyhow::Result<CandidateFeatures> {
        let layout = FeatureLayout { action_length: space.length() };
        let well_formed: Vec<(&Candidate, CandidateAction<'_>)> =
            candidates.iter().filter_map(|one| Some((one, one.action()?))).collect();
        for (candidate, action) in &well_formed {
            let (expected, got) = (layout.confidence().len(), candidate.confidence.len());
            ensure!(
                got == expected,
                "expected a candidate with the log-probabilities of {expected} parts, got {got}"
            );
            let (expected, got) = (layout.action_length, action.actions.action_length());
            ensure!(got == expected, "expected actions with {expected} dimensions, got {got}");
        }
        let actions: Vec<Option<CandidateAction<'_>>> =
            well_formed.iter().map(|(_, action)| Some(*action)).collect();
        let scaled = |action: &CandidateAction<'_>| -> Vec<f32> {
            let count = action.actions.actions().len() as f32;
            let numbers = motion(action.actions).into_iter().zip(&space.scale);
            let scaled = |(sum, scale): (f32, &f32)| {
                if *scale > 0.0 { sum / count / scale } else { 0.0 }
            };
            numbers.map(scaled).collect()
        };
        let scaled: Vec<Vec<f32>> = well_formed.iter().map(|(_, action)| scaled(action)).collect();
        let action_mean = mean(&scaled, layout.action_length);
        let row = |(index, (candidate, action)): (usize, &(&Candidate, CandidateAction<'_>))| {
            let mut row = vec![0.0; layout.length()];
            row[layout.confidence()].copy_from_slice(&candidate.confidence);
            let numbers = scaled[index].iter().zip(&action_mean);
            for (deviation, (value, mean)) in row[layout.deviations()].iter_mut().zip(numbers) {
                *deviation = (value - mean).abs();
            }
            row[layout.nearness()] = -distance_mean(&actions, index, action, space) as f32;
            row
        };
        let mut rows: Vec<Vec<f32>> = well_formed.iter().enumerate().map(row).collect();
        let rows_mean = mean(&rows, layout.length());
        for row in &mut rows {
            row.iter_mut().zip(&rows_mean).for_each(|(value, mean)| *value -= mean);
        }
        let motions = well_formed.iter().map(|(_, action)| {
            let motion = motion(action.actions);
            [0, 1].map(|axis| motion.get(axis).copied().unwrap_or(0.0))
        });
        Ok(CandidateFeatures { layout, motions: motions.collect(), rows })
    }

    /// Sets the target features: how much nearer to the target than the mean each candidate brings
    /// the gripper.
    pub fn set_target(&mut self, target: Option<PredictedTarget>) {
        let distances = |target: PredictedTarget| {
            self.motions.iter().map(move |motion| -target.distance(*motion))
        };
        let count = self.motions.len() as f32;
        let mean = target.map_or(0.0, |target| distances(target).sum::<f32>() / count);
        for (row, motion) in self.rows.iter_mut().zip(&self.motions) {
            row[self.layout.target()].fill(0.0);
            if let Some(target) = target {
                let feature = self.layout.target().start + target.stage as usize;
                row[feature] = -target.distance(*motion) - mean;
            }
        }
    }

    /// The meaning of the features.
    pub fn layout(&self) -> FeatureLayout {
        self.layout
    }

    /// One row per well-formed candidate, in order.
    pub fn rows(&self) -> &[Vec<f32>] {
        &self.rows
    }
}

/// The sum of a chunk's actions in each dimension.
fn motion(actions: &ActionChunk) -> Vec<f32> {
    let mut sum = vec![0.0; actions.action_length()];
    for action in actions.actions() {
        sum.iter_mut().zip(action).for_each(|(sum, number)| *sum += number);
    }
    sum
}

/// The mean of rows of `length` values; zeros if there are no rows.
fn mean(rows: &[Vec<f32>], length: usize) -> Vec<f32> {
    let mut sum = vec![0.0; length];
    for row in rows {
        sum.iter_mut().zip(row).for_each(|(sum, value)| *sum += value);
    }
    sum.iter_mut().for_each(|sum| *sum /= rows.len().max(1) as f32);
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use decision::{Malformed, Parsed, Reasoning, Stage};

    const BRIDGE: FeatureLayout = FeatureLayout { action_length: 7 };

    fn space() -> ActionSpace {
        ActionSpace { scale: vec![0.1, 0.1, 0.1, 0.0, 0.1, 0.1, 2.0], gripper: Some(6) }
    }

    fn candidate(tokens: Vec<u32>, actions: Vec<Vec<f32>>, confidence: Vec<f32>) -> Candidate {
        let actions = ActionChunk::new(actions).expect("finite");
        Candidate {
            tokens: Vec::new(),
            log_probability: -1.0,
            log_probabilities: Vec::new(),
            confidence,
            hidden: Vec::new(),
            parsed: Ok(Parsed { reasoning: Reasoning::default(), action_tokens: tokens, actions }),
        }
    }

    /// A candidate that moves by x. The larger x is, the lower is the confidence of its third part.
    fn moving(x: f32, bin: u32, gripper: f32) -> Candidate {
        let tokens = vec![bin, 500, 500, 500, 500, 500, if gripper > 0.0 { 599 } else { 400 }];
        let mut confidence = vec![0.0; BRIDGE.confidence().len()];
        confidence[2] = -10.0 * x;
        candidate(tokens, vec![vec![x, 0.0, 0.0, 9.0, 0.0, 0.0, gripper]], confidence)
    }

    fn malformed() -> Candidate {
        Candidate {
            parsed: Err(Malformed::new("expected an action, got none")),
            ..moving(0.1, 500, 1.0)
        }
    }

    fn check(rows: &[Vec<f32>], index: usize, expected: [f32; 3]) {
        let found: Vec<f32> = rows.iter().map(|row| row[index]).collect();
        let near = found.iter().zip(expected).all(|(found, one)| (found - one).abs() < 1e-5);
        assert!(near && found.len() == 3, "feature {index}: expected {expected:?}, got {found:?}");
    }

    #[test]
    fn features_are_relative_to_the_other_candidates() {
        let candidates =
            [moving(0.1, 500, 1.0), malformed(), moving(0.3, 551, 1.0), moving(0.2, 500, -1.0)];
        let mut features = CandidateFeatures::of(&candidates, &space()).expect("whole");
        // Log-probabilities -1, -3 and -2.
        check(features.rows(), 2, [1.0, -1.0, 0.0]);
        // x deviates by 1, 1 and 0 units of 0.1; the mean deviation is 2/3.
        let deviations = BRIDGE.deviations().start;
        check(features.rows(), deviations, [1.0 / 3.0, 1.0 / 3.0, -2.0 / 3.0]);
        // Roll has no range here.
        check(features.rows(), deviations + 3, [0.0; 3]);
        // One unit of the gripper is 2. Two candidates open it, one closes it, so the mean is 1/3.
        check(features.rows(), deviations + 6, [-1.0 / 9.0, -1.0 / 9.0, 2.0 / 9.0]);
        // Mean distances 0.6, 0.7 and 1.1: 51 bins are a fifth of the range, an opposite gripper
        // command is 1.
        check(features.rows(), BRIDGE.nearness(), [0.2, 0.1, -0.3]);
        check(features.rows(), BRIDGE.target().start + 1, [0.0; 3]);
        // Nothing is grasped; the distances to the target are 10, 10 and 0 cm.
        features.set_target(Some(PredictedTarget { stage: Stage::Place, offset: [0.2, 0.0] }));
        check(features.rows(), BRIDGE.target().start, [0.0; 3]);
        check(features.rows(), BRIDGE.target().start + 1, [-0.1 / 3.0, -0.1 / 3.0, 0.2 / 3.0]);
        features.set_target(None);
        check(features.rows(), BRIDGE.target().start + 1, [0.0; 3]);
    }

    #[test]
    fn actions_may_have_any_length_and_chunks_any_number_of_them() {
        let space = ActionSpace { scale: vec![0.5, 1.0], gripper: None };
        let layout = FeatureLayout { action_length: 2 };
        let chunk = |x: f32| vec![vec![x, 0.0], vec![2.0 * x, 0.0]];
        let of = |x: f32| candidate(Vec::new(), chunk(x), vec![0.0; layout.confidence().len()]);
        let candidates = [of(1.0), of(2.0), of(3.0)];
        let mut features = CandidateFeatures::of(&candidates, &space).expect("whole");
        assert_eq!((layout.length(), features.layout()), (16, layout));
        // The means 1.5, 3 and 4.5 deviate by 3, 0 and 3 units of 0.5.
        check(features.rows(), layout.deviations().start, [1.0, -2.0, 1.0]);
        // The motions are 3, 6 and 9.
        features.set_target(Some(PredictedTarget { stage: Stage::Grasp, offset: [9.0, 0.0] }));
        check(features.rows(), layout.target().start, [-3.0, 0.0, 3.0]);
    }

    #[test]
    fn a_lone_candidate_has_no_advantage() {
        let weights = vec![3.0; BRIDGE.length()];
        let ranking = Ranking::new(BRIDGE, weights, TargetModel::default()).expect("finite");
        let features = CandidateFeatures::of(&[malformed(), moving(0.3, 551, -1.0)], &space());
        assert_eq!(ranking.advantage(&features.expect("whole").rows()[0]), 0.0);
        let features = CandidateFeatures::of(&[malformed(), malformed()], &space());
        assert!(features.expect("whole").rows().is_empty());
    }

    #[test]
    fn candidates_of_another_policy_are_refused() {
        let mut other = moving(0.1, 500, 1.0);
        other.confidence.pop();
        let refuse = |candidate: Candidate, space: &ActionSpace| {
            CandidateFeatures::of(&[candidate], space).expect_err("refused").to_string()
        };
        assert_eq!(
            refuse(other, &space()),
            "expected a candidate with the log-probabilities of 16 parts, got 15"
        );
        let mut shorter = moving(0.1, 500, 1.0);
        shorter.confidence.pop();
        let space = ActionSpace { scale: vec![1.0; 6], gripper: None };
        assert_eq!(refuse(shorter, &space), "expected actions with 6 dimensions, got 7");
    }

    #[test]
    fn weights_that_are_not_finite_or_too_large_are_refused() {
        let refuse = |weights: Vec<f32>| {
            let ranking = Ranking::new(BRIDGE, weights, TargetModel::default());
            ranking.expect_err("refused").to_string()
        };
        let with = |weight: f32| vec![weight; BRIDGE.length()];
        assert_eq!(refuse(with(f32::NAN)), "ranking weights: expected at most 1000000, got NaN");
        assert!(refuse(with(3e38)).starts_with("ranking weights: expected at most 1000000, got 3"));
        assert_eq!(refuse(vec![0.0; 25]), "ranking weights: expected 26 values, got 25");
    }
}
