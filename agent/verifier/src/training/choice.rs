//! Fits the choice part: what makes a candidate better than its siblings, by ridge regression on advantages.
//!
//! No weight may say that a candidate is the better the less sure the policy was of it, or the farther it is from its
//! siblings. Freak draws are rare, so that a free regression gives them whatever weight chance gives them; and whoever
//! chooses among five looks for them.

use anyhow::Result;

use super::advantage::{FOLDS, Lesson, advantages, lessons};
use super::aim;
use super::decision::DecisionSample;
use super::set::TrainingSet;
use crate::verifier::{AIM, TargetModel, Choice, ChoiceEvidence, FEATURES, Features, Gain, NEARNESS, Options, PENALTIES, retarget};

/// Fewer episodes teach nothing about single decisions.
const EPISODES_MIN: usize = 20;
/// A feature that varies less carries nothing.
const SCALE_MIN: f64 = 1e-6;
/// Rounds of coordinate descent: far more than so few weights take to settle, and still only milliseconds.
const ROUNDS: usize = 1000;

/// The features of every decision's candidates, lesson by lesson.
type Rows = Vec<Vec<Vec<Features>>>;

/// The choice part of all episodes with decisions, and what it is worth; none when there are too few of them.
pub fn fit(set: &TrainingSet, options: &Options) -> Result<Option<(Choice, ChoiceEvidence)>> {
    let lessons = lessons(set.episodes(), options.seed);
    if lessons.len() < EPISODES_MIN {
        return Ok(None);
    }
    let advantages = advantages(&lessons, options.advantage_decay, options.seed)?;
    let rows = rows(&lessons)?;
    let fit = |is_used: &dyn Fn(&Lesson<'_>) -> bool| {
        let used = lessons.iter().zip(&rows).zip(&advantages);
        let used = used.filter(|((lesson, _), _)| is_used(lesson));
        let executed = used.flat_map(|((_, rows), advantages)| {
            rows.iter().map(|row| &row[0]).zip(advantages.iter().copied())
        });
        regress(&executed.collect::<Vec<_>>(), options.choice_ridge)
    };
    let folds: Vec<Features> =
        (0..FOLDS).map(|fold| fit(&|lesson: &Lesson<'_>| lesson.fold != fold)).collect();
    let evidence = ChoiceEvidence {
        episodes: lessons.len(),
        decisions: lessons.iter().map(|lesson| lesson.decisions.len()).sum(),
        gain: gain(&lessons, &rows, &advantages, |lesson, features| {
            let weights = &folds[lesson.fold];
            weights.iter().zip(features).map(|(weight, value)| weight * value).sum()
        }),
        medoid_gain: gain(&lessons, &rows, &advantages, |_, features| features[NEARNESS]),
    };
    let mut weights = fit(&|_| true);
    weights[AIM].iter_mut().for_each(|weight| *weight *= options.aim_factor as f32);
    let choice = Choice::new(weights, aim::fit(&lessons, |_| true)?)?;
    Ok(Some((choice, evidence)))
}

/// With targets that were learnt from the lessons of the other folds: of its own ones a target knows too much.
fn rows(lessons: &[Lesson<'_>]) -> Result<Rows> {
    let others = |fold: usize| aim::fit(lessons, |lesson| lesson.fold != fold);
    let target_model: Vec<TargetModel> = (0..FOLDS).map(others).collect::<Result<_>>()?;
    let rows = lessons.iter().map(|lesson| {
        let decisions = lesson.decisions.iter().map(|decision| {
            let DecisionSample { candidates, actions, gripper, tracked, .. } = decision;
            let target = target_model[lesson.fold].target(lesson.instruction, tracked, *gripper);
            let mut candidates = candidates.clone();
            retarget(&mut candidates, actions, target);
            candidates
        });
        decisions.collect()
    });
    Ok(rows.collect())
}

/// Ridge regression of advantages on the executed candidates' standardised features.
fn regress(samples: &[(&Features, f64)], ridge: f64) -> Features {
    let count = samples.len().max(1) as f64;
    let scales = scales(samples);
    let mut squares = [[0.0; FEATURES]; FEATURES];
    let mut products = [0.0; FEATURES];
    for (features, advantage) in samples {
        let row: [f64; FEATURES] =
            std::array::from_fn(|index| f64::from(features[index]) / scales[index]);
        for (left, squares) in row.iter().zip(&mut squares) {
            squares.iter_mut().zip(row).for_each(|(sum, right)| *sum += left * right / count);
        }
        products.iter_mut().zip(row).for_each(|(sum, value)| *sum += value * advantage / count);
    }
    let weights = descend(&squares, &products, ridge);
    std::array::from_fn(|index| (weights[index] / scales[index]) as f32)
}

/// The weights of least squared error plus ridge, each on its side of 0, by coordinate descent.
fn descend(
    squares: &[[f64; FEATURES]; FEATURES],
    products: &[f64; FEATURES],
    ridge: f64,
) -> [f64; FEATURES] {
    let mut weights = [0.0; FEATURES];
    for _ in 0..ROUNDS {
        for index in 0..FEATURES {
            let others: f64 = (0..FEATURES)
                .filter(|other| *other != index)
                .map(|other| squares[index][other] * weights[other])
                .sum();
            let best = (products[index] - others) / (squares[index][index] + ridge);
            weights[index] = if PENALTIES.contains(&index) { best.min(0.0) } else { best.max(0.0) };
        }
    }
    weights
}

/// Root mean square of each feature; infinite, which gives it no weight, when it does not vary.
fn scales(samples: &[(&Features, f64)]) -> [f64; FEATURES] {
    let count = samples.len().max(1) as f64;
    std::array::from_fn(|index| {
        let squares = samples.iter().map(|(features, _)| f64::from(features[index]).powi(2));
        let scale = (squares.sum::<f64>() / count).sqrt();
        if scale < SCALE_MIN { f64::INFINITY } else { scale }
    })
}

/// What choosing by `score` in one decision at a time would change, summed over an episode.
///
/// The executed candidate was a uniform draw, so each decision in which it happens to be the best one counts as many
/// times as there were candidates: an estimate without bias for a single decision.
fn gain(
    lessons: &[Lesson<'_>],
    rows: &Rows,
    advantages: &[Vec<f64>],
    score: impl Fn(&Lesson<'_>, &Features) -> f32,
) -> Gain {
    let episode =
        |((lesson, rows), advantages): ((&Lesson<'_>, &Vec<Vec<Features>>), &Vec<f64>)| {
            rows.iter()
                .zip(advantages)
                .map(|(candidates, advantage)| {
                    let scores = candidates.iter().map(|features| score(lesson, features));
                    let scores: Vec<f32> = scores.collect();
                    let largest = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
                    let ties = scores.iter().filter(|score| **score == largest).count() as f64;
                    let is_best = f64::from(u8::from(scores[0] == largest));
                    (is_best * scores.len() as f64 / ties - 1.0) * advantage * 100.0
                })
                .sum::<f64>()
        };
    let episodes: Vec<f64> = lessons.iter().zip(rows).zip(advantages).map(episode).collect();
    let count = episodes.len() as f64;
    let points = episodes.iter().sum::<f64>() / count;
    let squares: f64 = episodes.iter().map(|value| (value - points).powi(2)).sum();
    Gain { points, standard_error: (squares / (count - 1.0) / count).sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vla::PARTS;
    use decision::CandidateAction;
    use crate::training::{DecisionSample, LabelledEpisode, STATISTICS};
    use decision::TrackedObjects;
    use crate::verifier::{Sibling, features};
    use rand::rngs::StdRng;
    use rand::{Rng, SeedableRng};

    /// Episodes of 20 decisions among five candidates; success rises with how sure the executed ones were of part 6.
    /// Part 2 is as variable and means nothing; a low part 4 helps, which no verifier may believe.
    fn taught(episodes: usize, strength: f64) -> TrainingSet {
        let mut random = StdRng::seed_from_u64(7);
        let mut episode = |number: usize| {
            let mut sum = 0.0;
            let decisions: Vec<DecisionSample> = (0..20)
                .map(|_| {
                    let mut sibling = || {
                        let mut confidence = [0.0; PARTS];
                        confidence[2] = random.random_range(-2.0..0.0_f32);
                        confidence[4] = random.random_range(-1.0..0.0_f32);
                        confidence[6] = random.random_range(-2.0..0.0_f32);
                        let action = CandidateAction { tokens: [500; 7], action: [0.0; 7] };
                        Some(Sibling { action, confidence, words: None })
                    };
                    let siblings: Vec<_> = (0..5).map(|_| sibling()).collect();
                    let candidates: Vec<Features> =
                        features(&siblings, &[1.0; 7], None).into_iter().flatten().collect();
                    sum += f64::from(candidates[0][6] - candidates[0][4]);
                    DecisionSample {
                        hidden_mean: vec![0.5, 0.25],
                        statistics: [0.0; STATISTICS],
                        actions: vec![[0.0; 7]; candidates.len()],
                        candidates,
                        gripper: [0.0; 2],
                        tracked: TrackedObjects::default(),
                    }
                })
                .collect();
            LabelledEpisode {
                name: format!("episode {number:04}"),
                task: "widowx_stack_cube".to_owned(),
                instruction: "stack".to_owned(),
                is_success: random.random_bool(1.0 / (1.0 + (-strength * sum).exp())),
                hidden: vec![0.5; 40],
                steps: (0..20).collect(),
                steps_total: 20,
                decisions: Some(decisions),
            }
        };
        TrainingSet::new(2, (0..episodes).map(&mut episode).collect::<Vec<_>>()).expect("whole")
    }

    #[test]
    fn what_makes_candidates_better_is_found() {
        let fitted = fit(&taught(400, 0.7), &Options::default()).expect("it can be fitted");
        let (choice, evidence) = fitted.expect("enough episodes");
        let weights = choice.weights();
        assert!(weights[6] > 0.02 && weights[2].abs() < 0.4 * weights[6], "{weights:?}");
        assert_eq!((weights[4], weights[PARTS]), (0.0, 0.0));
        let Gain { points, standard_error } = evidence.gain;
        assert!(points > 3.0 * standard_error && points > 10.0, "{evidence:?}");
        // All actions are the same, so that the medoid is a draw.
        assert!(evidence.medoid_gain.points.abs() < 1e-9, "{evidence:?}");
        assert_eq!((evidence.episodes, evidence.decisions), (400, 8000));
    }

    #[test]
    fn nothing_is_claimed_where_nothing_is() {
        let fitted = fit(&taught(200, 0.0), &Options::default()).expect("it can be fitted");
        let Gain { points, standard_error } = fitted.expect("enough episodes").1.gain;
        assert!(points.abs() < 3.0 * standard_error, "{points} and {standard_error}");
        assert!(fit(&taught(19, 0.5), &Options::default()).expect("no fault").is_none());
    }
}
