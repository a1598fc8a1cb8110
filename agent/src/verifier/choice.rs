//! Which of several candidates is better, as outcomes have shown.
//!
//! The score of a hidden state mostly says how promising the situation is, which is the same for all candidates of one
//! decision. This part looks only at what differs: how each candidate's action deviates from the mean of its siblings.
//! It is linear, because one action changes an episode's outcome by little and only few numbers can be learnt from that.

use std::collections::BTreeMap;

use anyhow::ensure;

use crate::strategy::{CandidateAction, distance_mean};

/// Numbers of an action, and so of a deviation.
pub const DEVIATIONS: usize = 7;
/// Signed deviations, their sizes, and the nearness to the siblings.
pub const FEATURES: usize = 2 * DEVIATIONS + 1;

/// How one candidate differs from its siblings; every feature's mean over the siblings is 0.
pub type Features = [f32; FEATURES];

/// The learnt weights: the change of the probability of success per unit of each feature.
#[derive(Clone, Debug, PartialEq)]
pub struct Choice {
    /// For every instruction.
    pub shared: Features,
    /// What is added for the signed deviations under an instruction that was trained on.
    ///
    /// A policy's systematic error has another direction in each task.
    pub instructions: BTreeMap<String, [f32; DEVIATIONS]>,
}

impl Choice {
    /// Refuses weights that are not numbers.
    pub fn checked(self) -> anyhow::Result<Choice> {
        let mut weights = self.shared.iter().chain(self.instructions.values().flatten());
        ensure!(
            weights.all(|weight| weight.is_finite()),
            "choice weights: expected finite values, got NaN or infinity"
        );
        Ok(self)
    }

    /// The change of the probability of success that a candidate brings, against the mean of its siblings.
    pub fn advantage(&self, instruction: &str, features: &Features) -> f32 {
        let shared: f32 =
            self.shared.iter().zip(features).map(|(weight, value)| weight * value).sum();
        let own = self.instructions.get(instruction).map_or(0.0, |weights| {
            weights.iter().zip(features).map(|(weight, value)| weight * value).sum()
        });
        shared + own
    }
}

/// The features of every well-formed candidate; `action_scale` is one unit of each number of an action.
///
/// A dimension without range cannot tell candidates apart and has deviation 0.
pub fn features(
    candidates: &[Option<CandidateAction>],
    action_scale: &[f32; DEVIATIONS],
) -> Vec<Option<Features>> {
    let raw: Vec<Option<Features>> = deviations(candidates, action_scale)
        .into_iter()
        .enumerate()
        .map(|(index, deviation)| {
            let own = candidates[index].as_ref()?;
            let deviation = deviation?;
            let mut features = [0.0; FEATURES];
            for (number, value) in deviation.iter().enumerate() {
                features[number] = *value;
                features[DEVIATIONS + number] = value.abs();
            }
            features[FEATURES - 1] = -distance_mean(candidates, index, own) as f32;
            Some(features)
        })
        .collect();
    let mean: Features = mean(raw.iter().flatten());
    let centre = |features: Features| std::array::from_fn(|index| features[index] - mean[index]);
    raw.into_iter().map(|features| features.map(centre)).collect()
}

/// Each action in units of the scale, less the mean of all.
fn deviations(
    candidates: &[Option<CandidateAction>],
    action_scale: &[f32; DEVIATIONS],
) -> Vec<Option<[f32; DEVIATIONS]>> {
    let scaled = |candidate: &CandidateAction| -> [f32; DEVIATIONS] {
        std::array::from_fn(|index| {
            let scale = action_scale[index];
            if scale > 0.0 { candidate.action[index] / scale } else { 0.0 }
        })
    };
    let actions: Vec<Option<[f32; DEVIATIONS]>> =
        candidates.iter().map(|candidate| candidate.as_ref().map(scaled)).collect();
    let mean: [f32; DEVIATIONS] = mean(actions.iter().flatten());
    let deviate =
        |action: [f32; DEVIATIONS]| std::array::from_fn(|index| action[index] - mean[index]);
    actions.into_iter().map(|action| action.map(deviate)).collect()
}

/// The mean of rows; zeros when there is none.
fn mean<'a, const SIZE: usize>(rows: impl Iterator<Item = &'a [f32; SIZE]>) -> [f32; SIZE] {
    let (mut sum, mut count) = ([0.0; SIZE], 0_u32);
    for row in rows {
        sum.iter_mut().zip(row).for_each(|(sum, value)| *sum += value);
        count += 1;
    }
    sum.map(|sum| sum / count.max(1) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCALE: [f32; 7] = [0.1, 0.1, 0.1, 0.0, 0.1, 0.1, 2.0];

    fn at(x: f32, bin: u32, gripper: f32) -> Option<CandidateAction> {
        let tokens = [bin, 500, 500, 500, 500, 500, if gripper > 0.0 { 599 } else { 400 }];
        Some(CandidateAction { tokens, action: [x, 0.0, 0.0, 9.0, 0.0, 0.0, gripper] })
    }

    #[test]
    fn features_are_relative_to_the_siblings() {
        let candidates = [at(0.1, 500, 1.0), None, at(0.3, 551, 1.0), at(0.2, 500, -1.0)];
        let rows = features(&candidates, &SCALE);
        assert!(rows[1].is_none());
        let rows: Vec<Features> = rows.into_iter().flatten().collect();
        // x deviates by -1, +1 and 0 units of 0.1; the sizes' mean is 2/3.
        let column = |index: usize| [rows[0][index], rows[1][index], rows[2][index]];
        let near = |found: [f32; 3], expected: [f32; 3]| {
            found.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-5)
        };
        assert!(near(column(0), [-1.0, 1.0, 0.0]), "{:?}", column(0));
        assert!(near(column(7), [1.0 / 3.0, 1.0 / 3.0, -2.0 / 3.0]), "{:?}", column(7));
        // The gripper: two open, one closed; one unit is 2.
        assert!(near(column(6), [1.0 / 3.0, 1.0 / 3.0, -2.0 / 3.0]), "{:?}", column(6));
        // Roll has no range here.
        assert_eq!(column(3), [0.0; 3]);
        // Mean distances 0.6, 0.7 and 1.1 (51 bins are a fifth of the range, the other gripper side is 1).
        assert!(near(column(14), [0.2, 0.1, -0.3]), "{:?}", column(14));
    }

    #[test]
    fn a_lone_candidate_has_no_advantage() {
        let choice = Choice { shared: [3.0; FEATURES], instructions: BTreeMap::new() };
        let rows = features(&[None, at(0.3, 551, -1.0)], &SCALE);
        assert_eq!(choice.advantage("any", &rows[1].expect("well formed")), 0.0);
        assert!(features(&[None, None], &SCALE).iter().all(Option::is_none));
    }

    #[test]
    fn instructions_add_their_own_direction() {
        let mut shared = [0.0; FEATURES];
        shared[14] = 1.0;
        let own = [2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let instructions = BTreeMap::from([("put it there".to_owned(), own)]);
        let choice = Choice { shared, instructions }.checked().expect("finite");
        let mut features = [0.0; FEATURES];
        (features[0], features[14]) = (0.5, 0.25);
        assert_eq!(choice.advantage("put it there", &features), 1.25);
        assert_eq!(choice.advantage("never heard of", &features), 0.25);
        let broken = Choice { shared: [f32::NAN; FEATURES], instructions: BTreeMap::new() };
        assert!(broken.checked().is_err());
    }
}
