//! Fits the target model to the gripper's positions at grasps and at releases of successes.
//!
//! A grasp happens at the first object of the reasoning, and a success releases it at the second
//! one. Each single position is a few millimetres off, because actions are sampled; the regression
//! over hundreds of them is precise.

use std::collections::BTreeMap;

use decision::Stage;

use super::advantage::RankingEpisode;
use super::decision_sample::DecisionSample;
use super::least_squares::NormalEquations;
use crate::{TERMS, TargetMap, TargetModel, terms};

/// Minimum number of samples per map, because it has so many terms.
const SAMPLES_MIN: usize = 40;
/// Ridge penalty: the sum of squared distances grows by this times each squared coefficient. It
/// keeps terms that hardly vary from being fitted to noise.
const RIDGE: f64 = 0.1;
/// A sample is an outlier if its distance from the first fit exceeds this many median distances.
/// Outliers are excluded from the second fit.
const OUTLIER_MEDIANS: f64 = 3.0;

/// A gripper position: the terms of the object's bounds, and the gripper's x and y.
type Sample = ([f64; TERMS], [f64; 2]);

/// The maps of all instructions with enough samples in the used episodes.
pub fn fit(
    episodes: &[RankingEpisode<'_>],
    is_used: impl Fn(&RankingEpisode<'_>) -> bool,
) -> anyhow::Result<TargetModel> {
    let mut samples: BTreeMap<(&str, Stage), Vec<Sample>> = BTreeMap::new();
    for RankingEpisode { episode, decisions, .. } in episodes.iter().filter(|one| is_used(one)) {
        // Until the first grasp the object has not moved; at its release it is at its destination.
        let first = decisions.iter().find(|decision| decision.is_grasped());
        let last = decisions.iter().rev().find(|decision| decision.is_grasped());
        let found = [(Stage::Grasp, first), (Stage::Place, last.filter(|_| episode.is_success))];
        for (stage, decision) in found {
            if let Some(sample) = decision.and_then(|decision| sample(decision, stage)) {
                samples.entry((episode.instruction.as_str(), stage)).or_default().push(sample);
            }
        }
    }
    let mut target_model = TargetModel::default();
    for ((instruction, stage), samples) in samples {
        if samples.len() >= SAMPLES_MIN {
            target_model.insert(instruction, stage, map(&samples)?);
        }
    }
    Ok(target_model)
}

fn sample(decision: &DecisionSample, stage: Stage) -> Option<Sample> {
    let bounds = decision.tracked.bounds[stage as usize]?;
    Some((terms(&bounds), decision.gripper?.map(f64::from)))
}

/// Least squares with ridge, twice: the second fit excludes the outliers of the first.
fn map(samples: &[Sample]) -> anyhow::Result<TargetMap> {
    let all: Vec<&Sample> = samples.iter().collect();
    let first = solve(&all);
    let distance = |(terms, gripper): &Sample| {
        let [x, y] = [0, 1].map(|axis| {
            let products = terms.iter().zip(&first[axis]);
            products.map(|(term, coefficient)| term * coefficient).sum::<f64>() - gripper[axis]
        });
        x.hypot(y)
    };
    let mut distances: Vec<f64> = samples.iter().map(distance).collect();
    distances.sort_by(f64::total_cmp);
    let limit = OUTLIER_MEDIANS * distances[distances.len() / 2];
    let near: Vec<&Sample> = samples.iter().filter(|sample| distance(sample) <= limit).collect();
    let [x, y] = solve(&near);
    TargetMap::new(std::array::from_fn(|term| [x[term] as f32, y[term] as f32]))
}

/// The coefficients of x and of y.
fn solve(samples: &[&Sample]) -> [Vec<f64>; 2] {
    [0, 1].map(|axis| {
        let samples = samples.iter().map(|(terms, gripper)| (terms.to_vec(), gripper[axis]));
        let count = samples.len() as f64;
        let mut equations = NormalEquations::of(TERMS, samples);
        // The constant has no penalty.
        (1..TERMS).for_each(|term| equations.add_ridge(term, RIDGE / count));
        equations.solve()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::set::tests::episode;
    use crate::training::tests::decision;
    use decision::{BoundingBox, TrackedObjects};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// The true gripper position for a box, in metres.
    fn truth(bounds: &BoundingBox) -> [f32; 2] {
        let middle = [(bounds[0] + bounds[2]) / 2.0 - 128.0, (bounds[1] + bounds[3]) / 2.0 - 128.0];
        [0.3 + 0.002 * middle[1] + 4e-6 * middle[0] * middle[1], -0.1 - 0.0015 * middle[0]]
    }

    /// A decision with or without the object in the gripper, which is `off` metres from its true
    /// position.
    fn holding(bounds: BoundingBox, is_grasped: bool, off: f32) -> DecisionSample {
        let [x, y] = truth(&bounds);
        let mut decision = decision(&[vec![0.0; 16]]);
        decision.statistics[1] = f32::from(u8::from(is_grasped));
        decision.gripper = Some([x + off, y - off]);
        decision.tracked =
            TrackedObjects { stage: Some(Stage::Place), bounds: [None, Some(bounds)] };
        decision
    }

    #[test]
    fn maps_are_learned_from_successes_with_millimetre_precision() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut bounds = || -> BoundingBox {
            let (left, top) = (random.random_range(60.0..150.0), random.random_range(60.0..150.0));
            [
                left,
                top,
                left + random.random_range(30.0..40.0),
                top + random.random_range(20.0..26.0),
            ]
        };
        let boxes: Vec<BoundingBox> = (0..300).map(|_| bounds()).collect();
        let all = boxes.iter().enumerate().map(|(index, &bounds)| {
            // A tenth are outliers; the decisions before and after are not samples.
            let off = if index % 10 == 0 { 0.2 } else { 0.005 * ((index % 7) as f32 - 3.0) / 3.0 };
            let decisions = vec![
                holding(bounds, true, 0.1),
                holding(bounds, true, off),
                holding(bounds, false, 0.3),
            ];
            // Every tenth episode, except the outliers, is a failure, from which no release
            // position is learned.
            let mut one = episode("one", "stack", index as u64, index % 10 != 5);
            one.instruction = if index < 280 { "stack it" } else { "seldom" }.to_owned();
            (one, decisions)
        });
        let all: Vec<_> = all.collect();
        let episodes: Vec<RankingEpisode<'_>> = all
            .iter()
            .map(|(episode, decisions)| RankingEpisode { episode, decisions, fold: 0 })
            .collect();
        let target_model = fit(&episodes, |_| true).expect("finite");
        let known: Vec<_> = target_model.maps().map(|(name, stage, _)| (name, stage)).collect();
        assert_eq!(known, [("stack it", Stage::Place)]);
        let distance = |bounds: &BoundingBox| {
            let tracked =
                TrackedObjects { stage: Some(Stage::Place), bounds: [None, Some(*bounds)] };
            let target = target_model.predict("stack it", &tracked, Some(truth(bounds)));
            target.expect("a target").distance([0.0; 2])
        };
        let worst = boxes.iter().map(distance).fold(0.0, f32::max);
        assert!(worst < 0.004, "{worst} m");
    }
}
