//! Learns where the gripper should go from where it was when things went right.
//!
//! A grasp happens where the reasoning saw the object, and a success lets go where it saw the other one. Each single
//! position is millimetres off, as sampled actions are; the regression over hundreds of them is not.

use std::collections::BTreeMap;

use decision::Stage;

use super::advantage::RankingEpisode;
use super::decision_sample::DecisionSample;
use super::least_squares::NormalEquations;
use crate::{TERMS, TargetMap, TargetModel, terms};

/// Fewer samples say too little about so many terms.
const SAMPLES_MIN: usize = 40;
/// Keeps terms that hardly vary from being fitted to chance; the sum of the squared distances grows by this times each
/// squared coefficient.
const RIDGE: f64 = 0.1;
/// Samples farther from the first fit than this many times the median distance are outliers and left out of the second.
const OUTLIER_MEDIANS: f64 = 3.0;

/// The gripper where it should be: the terms of the object's bounds, and the gripper's x and y.
type Sample = ([f64; TERMS], [f64; 2]);

/// The maps of every instruction of which the episodes in use have enough samples.
pub fn fit(
    episodes: &[RankingEpisode<'_>],
    is_used: impl Fn(&RankingEpisode<'_>) -> bool,
) -> anyhow::Result<TargetModel> {
    let mut samples: BTreeMap<(&str, Stage), Vec<Sample>> = BTreeMap::new();
    for RankingEpisode { episode, decisions, .. } in episodes.iter().filter(|one| is_used(one)) {
        // An object is where it was seen until the first grasp; it was brought to its place when it is let go.
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

/// Least squares with ridge, twice: the second time without the outliers of the first.
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
        // The constant is free.
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

    /// Where the gripper belongs for a box, in metres.
    fn truth(bounds: &BoundingBox) -> [f32; 2] {
        let middle = [(bounds[0] + bounds[2]) / 2.0 - 128.0, (bounds[1] + bounds[3]) / 2.0 - 128.0];
        [0.3 + 0.002 * middle[1] + 4e-6 * middle[0] * middle[1], -0.1 - 0.0015 * middle[0]]
    }

    /// A decision with the object in the gripper or not, which is `off` metres from where it belongs.
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
    fn maps_are_learned_from_successes_to_the_millimetre() {
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
            // A tenth of them is nowhere near; what comes before and after is no sample.
            let off = if index % 10 == 0 { 0.2 } else { 0.005 * ((index % 7) as f32 - 3.0) / 3.0 };
            let decisions = vec![
                holding(bounds, true, 0.1),
                holding(bounds, true, off),
                holding(bounds, false, 0.3),
            ];
            // Every tenth but the outliers: a failure says nothing of where to let go.
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
