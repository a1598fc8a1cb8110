//! Learns where the gripper should go from where it was when things went right.
//!
//! A grasp happens where the object was said to be, and a success lets go where the other one was said to be. Each single
//! one is millimetres off, as sampled actions are; the regression over hundreds of them is not.

use std::collections::BTreeMap;

use super::advantage::Lesson;
use super::decision::DecisionSample;
use crate::verifier::{TargetModel, Place, TERMS, terms};
use decision::Stage;

/// Fewer moments say too little about so many terms.
const MOMENTS_MIN: usize = 40;
/// Keeps terms that hardly vary from being fitted to chance.
const RIDGE: f64 = 0.1;
/// Moments farther from the first fit than this many times the median distance are left out of the second.
const FREAK: f64 = 3.0;

/// When the gripper was where it should be: the object's terms, and the gripper's x and y.
type Moment = ([f64; TERMS], [f64; 2]);

/// The places of every instruction that the lessons in use have enough moments of.
pub fn fit(lessons: &[Lesson<'_>], is_used: impl Fn(&Lesson<'_>) -> bool) -> anyhow::Result<TargetModel> {
    let mut moments: BTreeMap<(&str, Stage), Vec<Moment>> = BTreeMap::new();
    for lesson in lessons.iter().filter(|lesson| is_used(lesson)) {
        // An object is where it was said to be until the first grasp; it was brought right when it is let go.
        let first = lesson.decisions.iter().find(|decision| decision.is_grasped());
        let last = lesson.decisions.iter().rev().find(|decision| decision.is_grasped());
        let found = [(Stage::Grasp, first), (Stage::Place, last.filter(|_| lesson.is_success))];
        for (stage, decision) in found {
            if let Some(moment) = decision.and_then(|decision| moment(decision, stage)) {
                moments.entry((lesson.instruction, stage)).or_default().push(moment);
            }
        }
    }
    let mut target_model = TargetModel::default();
    for ((instruction, stage), moments) in moments {
        if moments.len() >= MOMENTS_MIN {
            target_model.insert(instruction, stage, place(&moments)?);
        }
    }
    Ok(target_model)
}

fn moment(decision: &DecisionSample, stage: Stage) -> Option<Moment> {
    let bounds = decision.tracked.bounds[stage as usize]?;
    Some((terms(&bounds), decision.gripper.map(f64::from)))
}

/// Least squares with ridge, twice: the second time without the moments that the first one is far from.
fn place(moments: &[Moment]) -> anyhow::Result<Place> {
    let all: Vec<&Moment> = moments.iter().collect();
    let first = solve(&all);
    let mut distances: Vec<f64> = moments.iter().map(|moment| distance(moment, &first)).collect();
    distances.sort_by(f64::total_cmp);
    let limit = FREAK * distances[distances.len() / 2];
    let near: Vec<&Moment> =
        moments.iter().filter(|moment| distance(moment, &first) <= limit).collect();
    Place::new(solve(&near).map(|pair| pair.map(|number| number as f32)))
}

fn distance((terms, gripper): &Moment, coefficients: &[[f64; 2]; TERMS]) -> f64 {
    let at = |axis: usize| -> f64 {
        terms.iter().zip(coefficients).map(|(term, of)| term * of[axis]).sum()
    };
    (at(0) - gripper[0]).hypot(at(1) - gripper[1])
}

/// Coefficients of least squared distance plus ridge, by Cholesky factors of the normal equations.
fn solve(moments: &[&Moment]) -> [[f64; 2]; TERMS] {
    let mut squares = [[0.0; TERMS]; TERMS];
    let mut products = [[0.0; TERMS]; 2];
    for (terms, gripper) in moments {
        for (row, left) in squares.iter_mut().zip(terms) {
            row.iter_mut().zip(terms).for_each(|(sum, right)| *sum += left * right);
        }
        for (products, place) in products.iter_mut().zip(gripper) {
            products.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term * place);
        }
    }
    // The constant is free.
    (1..TERMS).for_each(|term| squares[term][term] += RIDGE);
    let lower = factor(squares);
    let [x, y] = products.map(|products| substitute(&lower, products));
    std::array::from_fn(|term| [x[term], y[term]])
}

/// The lower triangle L with L L' = `squares`; what stands above it means nothing.
fn factor(mut squares: [[f64; TERMS]; TERMS]) -> [[f64; TERMS]; TERMS] {
    for column in 0..TERMS {
        for row in column..TERMS {
            let done: f64 = (0..column).map(|k| squares[row][k] * squares[column][k]).sum();
            let rest = squares[row][column] - done;
            squares[row][column] =
                if row == column { rest.sqrt() } else { rest / squares[column][column] };
        }
    }
    squares
}

/// The solution of L L' x = `values`.
fn substitute(lower: &[[f64; TERMS]; TERMS], mut values: [f64; TERMS]) -> [f64; TERMS] {
    for row in 0..TERMS {
        let done: f64 = (0..row).map(|k| lower[row][k] * values[k]).sum();
        values[row] = (values[row] - done) / lower[row][row];
    }
    for row in (0..TERMS).rev() {
        let done: f64 = (row + 1..TERMS).map(|k| lower[k][row] * values[k]).sum();
        values[row] = (values[row] - done) / lower[row][row];
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use decision::{BoundingBox, TrackedObjects};
    use crate::verifier::FEATURES;
    use rand::rngs::StdRng;
    use rand::{Rng, SeedableRng};

    /// Where the gripper belongs for a box, in metres.
    fn truth(bounds: &BoundingBox) -> [f32; 2] {
        let middle = [(bounds[0] + bounds[2]) / 2.0 - 128.0, (bounds[1] + bounds[3]) / 2.0 - 128.0];
        [0.3 + 0.002 * middle[1] + 4e-6 * middle[0] * middle[1], -0.1 - 0.0015 * middle[0]]
    }

    /// A decision with the object in the gripper or not, which is `off` metres from where it belongs.
    fn decision(bounds: BoundingBox, is_grasped: bool, off: f32) -> DecisionSample {
        let mut statistics = [0.0; super::super::STATISTICS];
        statistics[1] = f32::from(u8::from(is_grasped));
        let [x, y] = truth(&bounds);
        DecisionSample {
            hidden_mean: vec![0.0],
            statistics,
            candidates: vec![[0.0; FEATURES]],
            actions: vec![[0.0; 7]],
            gripper: [x + off, y - off],
            tracked: TrackedObjects { stage: Some(Stage::Place), bounds: [None, Some(bounds)] },
        }
    }

    #[test]
    fn places_are_learnt_from_successes_millimetres_apart() {
        let mut random = StdRng::seed_from_u64(3);
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
        let decisions: Vec<Vec<DecisionSample>> = boxes
            .iter()
            .enumerate()
            .map(|(index, &bounds)| {
                // A tenth of them is nowhere near; what comes before and after is no moment.
                let off =
                    if index % 10 == 0 { 0.2 } else { 0.005 * ((index % 7) as f32 - 3.0) / 3.0 };
                vec![
                    decision(bounds, true, 0.1),
                    decision(bounds, true, off),
                    decision(bounds, false, 0.3),
                ]
            })
            .collect();
        let lesson = |(index, decisions)| Lesson {
            task: "stack",
            instruction: if index < 280 { "stack it" } else { "seldom" },
            // Every tenth but the freaks: a failure says nothing of where to let go.
            is_success: index % 10 != 5,
            decisions,
            fold: 0,
        };
        let decisions = decisions.iter().map(Vec::as_slice).enumerate();
        let lessons: Vec<Lesson<'_>> = decisions.map(lesson).collect();
        let target_model = fit(&lessons, |_| true).expect("finite");
        let known: Vec<_> = target_model.places().map(|(name, stage, _)| (name, stage)).collect();
        assert_eq!(known, [("stack it", Stage::Place)]);
        let worst = boxes.iter().map(|bounds| {
            let tracked = TrackedObjects { stage: Some(Stage::Place), bounds: [None, Some(*bounds)] };
            let target = target_model.target("stack it", &tracked, truth(bounds)).expect("a target");
            target.distance(&[0.0; 7])
        });
        let worst = worst.fold(0.0, f32::max);
        assert!(worst < 0.004, "{worst} m");
    }
}
