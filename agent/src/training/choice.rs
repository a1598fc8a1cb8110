//! Fits the choice part: which deviation from its siblings makes a candidate better, by ridge regression on advantages.

use std::collections::BTreeMap;

use anyhow::{Context, Result};
use nalgebra::{DMatrix, DVector};

use super::advantage::{FOLDS, Lesson, advantages, lessons};
use super::set::TrainingSet;
use crate::verifier::{Choice, ChoiceEvidence, DEVIATIONS, FEATURES, Features, Gain, Options};

/// Fewer episodes teach nothing about single decisions.
const EPISODES_MIN: usize = 20;
/// A feature that hardly varies, in units of the action scale, would be all noise once standardised.
const DEVIATION_MIN: f64 = 1e-3;

/// The choice part of all episodes with decisions, and what it is worth; none when there are too few of them.
pub fn fit(set: &TrainingSet, options: &Options) -> Result<Option<(Choice, ChoiceEvidence)>> {
    let lessons = lessons(set.episodes(), options.seed);
    if lessons.len() < EPISODES_MIN {
        return Ok(None);
    }
    let advantages = advantages(&lessons, options.advantage_decay, options.seed)?;
    let fit = |is_used: &dyn Fn(&Lesson<'_>) -> bool| {
        regress(&lessons, &advantages, is_used, options.choice_ridge)
    };
    let folds: Vec<Choice> = (0..FOLDS)
        .map(|fold| fit(&|lesson: &Lesson<'_>| lesson.fold != fold))
        .collect::<Result<_>>()?;
    let choice = fit(&|_| true)?;
    let by_choice = |lesson: &Lesson<'_>, features: &Features| {
        folds[lesson.fold].advantage(&lesson.decisions.instruction, features)
    };
    let evidence = ChoiceEvidence {
        instructions: choice.instructions.keys().cloned().collect(),
        episodes: lessons.len(),
        decisions: lessons.iter().map(|lesson| lesson.decisions.list.len()).sum(),
        gain: gain(&lessons, &advantages, by_choice),
        medoid_gain: gain(&lessons, &advantages, |_, features| features[FEATURES - 1]),
    };
    Ok(Some((choice, evidence)))
}

/// Ridge regression of advantages on the executed candidates' standardised features.
fn regress(
    lessons: &[Lesson<'_>],
    advantages: &[Vec<f64>],
    is_used: &dyn Fn(&Lesson<'_>) -> bool,
    ridge: f64,
) -> Result<Choice> {
    let used = || lessons.iter().zip(advantages).filter(|(lesson, _)| is_used(lesson));
    let samples = || {
        used().flat_map(|(lesson, advantages)| {
            let executed = lesson.decisions.list.iter().map(|decision| &decision.candidates[0]);
            let instruction = lesson.decisions.instruction.as_str();
            executed.zip(advantages).map(move |(features, value)| (instruction, features, *value))
        })
    };
    let count = samples().count().max(1) as f64;
    let scales = scales(samples().map(|(_, features, _)| features), count);
    let mut instructions: BTreeMap<&str, usize> = samples().map(|(text, ..)| (text, 0)).collect();
    for (index, start) in instructions.values_mut().enumerate() {
        *start = FEATURES + index * DEVIATIONS;
    }
    let size = FEATURES + instructions.len() * DEVIATIONS;
    let mut squares = DMatrix::<f64>::identity(size, size) * ridge;
    let mut products = DVector::<f64>::zeros(size);
    for (instruction, features, value) in samples() {
        let start = instructions[instruction];
        // Only these are not 0: the shared features, and the deviations under this instruction.
        let mut row = [(0, 0.0); FEATURES + DEVIATIONS];
        for index in 0..FEATURES {
            row[index] = (index, f64::from(features[index]) / scales[index]);
        }
        for index in 0..DEVIATIONS {
            row[FEATURES + index] = (start + index, row[index].1);
        }
        for (a, left) in row {
            products[a] += left * value / count;
            for (b, right) in row {
                squares[(a, b)] += left * right / count;
            }
        }
    }
    let weights = squares.cholesky().context("choice: the regression has no solution")?;
    let weights = weights.solve(&products);
    let weight = |at: usize, feature: usize| (weights[at] / scales[feature]) as f32;
    let own = |start: usize| std::array::from_fn(|index| weight(start + index, index));
    let instructions = instructions.iter().map(|(text, start)| ((*text).to_owned(), own(*start)));
    Choice {
        shared: std::array::from_fn(|index| weight(index, index)),
        instructions: instructions.collect(),
    }
    .checked()
}

/// Root mean square of each feature; infinite, which gives it no weight, when it hardly varies.
fn scales<'a>(features: impl Iterator<Item = &'a Features>, count: f64) -> [f64; FEATURES] {
    let mut squares = [0.0; FEATURES];
    for row in features {
        squares.iter_mut().zip(row).for_each(|(sum, value)| *sum += f64::from(*value).powi(2));
    }
    squares.map(|sum| {
        let scale = (sum / count).sqrt();
        if scale < DEVIATION_MIN { f64::INFINITY } else { scale }
    })
}

/// What choosing by `score` in one decision at a time would change, summed over an episode.
///
/// The executed candidate was a uniform draw, so each decision in which it happens to be the best one counts as many
/// times as there were candidates: an estimate without bias for a single decision.
fn gain(
    lessons: &[Lesson<'_>],
    advantages: &[Vec<f64>],
    score: impl Fn(&Lesson<'_>, &Features) -> f32,
) -> Gain {
    let episode = |(lesson, advantages): (&Lesson<'_>, &Vec<f64>)| -> f64 {
        let decisions = lesson.decisions.list.iter().zip(advantages);
        decisions
            .map(|(decision, advantage)| {
                let scores = decision.candidates.iter().map(|features| score(lesson, features));
                let scores: Vec<f32> = scores.collect();
                let largest = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
                let ties = scores.iter().filter(|score| **score == largest).count() as f64;
                let is_best = f64::from(u8::from(scores[0] == largest));
                (is_best * scores.len() as f64 / ties - 1.0) * advantage * 100.0
            })
            .sum()
    };
    let episodes: Vec<f64> = lessons.iter().zip(advantages).map(episode).collect();
    let count = episodes.len() as f64;
    let points = episodes.iter().sum::<f64>() / count;
    let variance =
        episodes.iter().map(|value| (value - points).powi(2)).sum::<f64>() / (count - 1.0);
    Gain { points, standard_error: (variance / count).sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::strategy::CandidateAction;
    use crate::training::{DecisionSample, Decisions, LabelledEpisode, STATISTICS};
    use crate::verifier::features;
    use rand::rngs::StdRng;
    use rand::{Rng, SeedableRng};

    /// Episodes of 20 decisions among five draws of x and y; success falls with the sum of the executed x under the
    /// first instruction and rises with it under the second. Nothing else matters.
    fn biased(episodes: usize, strength: f64) -> TrainingSet {
        let mut random = StdRng::seed_from_u64(7);
        let mut episode = |number: usize| {
            let sign = if number.is_multiple_of(2) { -1.0 } else { 1.0 };
            let mut sum = 0.0;
            let list: Vec<DecisionSample> = (0..20)
                .map(|_| {
                    let mut action = || {
                        let mut action = [0.0; 7];
                        action[0] = random.random_range(-1.0..1.0_f32);
                        action[1] = random.random_range(-1.0..1.0_f32);
                        Some(CandidateAction { tokens: [500; 7], action })
                    };
                    let actions: Vec<_> = (0..5).map(|_| action()).collect();
                    sum += f64::from(actions[0].expect("well formed").action[0]);
                    DecisionSample {
                        hidden_mean: vec![0.5, 0.25],
                        statistics: [0.0; STATISTICS],
                        candidates: features(&actions, &[1.0; 7]).into_iter().flatten().collect(),
                    }
                })
                .collect();
            let chance = 1.0 / (1.0 + (-sign * strength * sum).exp());
            LabelledEpisode {
                name: format!("episode {number:04}"),
                task: "widowx_stack_cube".to_owned(),
                is_success: random.random_bool(chance),
                hidden: vec![0.5; 40],
                steps: (0..20).collect(),
                steps_total: 20,
                decisions: Some(Decisions {
                    instruction: if sign < 0.0 { "pull" } else { "push" }.to_owned(),
                    list,
                }),
            }
        };
        TrainingSet::new(2, (0..episodes).map(&mut episode).collect::<Vec<_>>()).expect("whole")
    }

    #[test]
    fn a_bias_with_another_direction_per_instruction_is_found() {
        let (choice, evidence) =
            fit(&biased(400, 0.5), &Options::default()).expect("it can be fitted").expect("enough");
        let along = |instruction: &str, dimension: usize| {
            let mut features = [0.0; FEATURES];
            features[dimension] = 1.0;
            choice.advantage(instruction, &features)
        };
        assert!(along("push", 0) > 0.02 && along("pull", 0) < -0.02, "{choice:?}");
        let rest = ["push", "pull"].map(|text| along(text, 1).abs());
        assert!(rest.iter().all(|rest| *rest < 0.5 * along("push", 0)), "{choice:?}");
        // Roll never varied.
        assert_eq!(along("push", 3), 0.0);
        let Gain { points, standard_error } = evidence.gain;
        assert!(points > 3.0 * standard_error && points > 10.0, "{evidence:?}");
        assert!(evidence.medoid_gain.points < points / 2.0, "{evidence:?}");
        assert_eq!((evidence.episodes, evidence.decisions), (400, 8000));
        assert_eq!(evidence.instructions, ["pull", "push"]);
    }

    #[test]
    fn nothing_is_claimed_where_nothing_is() {
        let (_, evidence) =
            fit(&biased(200, 0.0), &Options::default()).expect("it can be fitted").expect("enough");
        let Gain { points, standard_error } = evidence.gain;
        assert!(points.abs() < 3.0 * standard_error, "{evidence:?}");
        assert!(fit(&biased(19, 0.5), &Options::default()).expect("no fault").is_none());
    }
}
