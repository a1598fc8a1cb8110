//! What each decision of an episode changed: the advantage of the executed action, by TD(lambda).
//!
//! The outcome alone is a poor label for one of sixty actions. A critic that knows the situation before and after tells
//! earlier what an action did. Its values are cross-fitted: an episode's own outcome never shapes its values.

use anyhow::Result;
use candle_nn::optim::{AdamW, Optimizer, ParamsAdamW};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;

use super::decision::DecisionSample;
use super::learner::{Learner, Samples};
use super::pass;
use super::set::LabelledEpisode;
use crate::verifier::{Network, Standardisation};

/// Parts of the episodes, of which each is valued by a critic that was fitted to the others.
pub const FOLDS: usize = 5;
/// The critic is smaller than the verifier: it must not remember episodes.
const HIDDEN_SIZES: [usize; 2] = [64, 32];
/// Passes over the decisions; more begin to remember.
const EPOCHS: usize = 4;
const BATCH_SAMPLES: usize = 256;
const LEARNING_RATE: f64 = 3e-4;
const WEIGHT_DECAY: f64 = 0.1;

/// An episode that teaches choosing.
pub struct Lesson<'a> {
    /// Its task.
    pub task: &'a str,
    /// What the robot was told.
    pub instruction: &'a str,
    /// Its outcome.
    pub is_success: bool,
    /// Its decisions.
    pub decisions: &'a [DecisionSample],
    /// The part that it belongs to.
    pub fold: usize,
}

impl Lesson<'_> {
    /// The lesson of an episode that has decisions.
    fn of(episode: &LabelledEpisode) -> Option<Lesson<'_>> {
        let LabelledEpisode { task, instruction, is_success, decisions, .. } = episode;
        let decisions = decisions.as_deref().filter(|decisions| !decisions.is_empty())?;
        Some(Lesson { task, instruction, is_success: *is_success, decisions, fold: 0 })
    }
}

/// The episodes with decisions, dealt to the folds.
pub fn lessons(episodes: &[LabelledEpisode], seed: u64) -> Vec<Lesson<'_>> {
    let mut lessons: Vec<Lesson<'_>> = episodes.iter().filter_map(Lesson::of).collect();
    let mut folds: Vec<usize> = (0..lessons.len()).map(|index| index % FOLDS).collect();
    folds.shuffle(&mut StdRng::seed_from_u64(seed));
    lessons.iter_mut().zip(folds).for_each(|(lesson, fold)| lesson.fold = fold);
    lessons
}

/// The advantage of every executed action, lesson by lesson, as changes of the probability of success.
///
/// delta_t = V(t + 1) - V(t), the last one with the outcome in place of V; A_t = delta_t + decay A_(t + 1).
pub fn advantages(lessons: &[Lesson<'_>], decay: f64, seed: u64) -> Result<Vec<Vec<f64>>> {
    let rows = rows(lessons);
    let mut advantages = vec![Vec::new(); lessons.len()];
    for fold in 0..FOLDS {
        let critic = Critic::fit(lessons, &rows, |lesson| lesson.fold != fold, seed)?;
        for (index, lesson) in lessons.iter().enumerate().filter(|(_, one)| one.fold == fold) {
            let values: Vec<f64> = rows[index].iter().map(|row| critic.value(row)).collect();
            advantages[index] = accumulate(&values, lesson.is_success, decay);
        }
    }
    Ok(advantages)
}

fn accumulate(values: &[f64], is_success: bool, decay: f64) -> Vec<f64> {
    let mut next_value = f64::from(u8::from(is_success));
    let mut later = 0.0;
    let mut advantages: Vec<f64> = values
        .iter()
        .rev()
        .map(|value| {
            later = next_value - value + decay * later;
            next_value = *value;
            later
        })
        .collect();
    advantages.reverse();
    advantages
}

/// What the critic reads of each decision: hidden state, flags of the simulator, step, task.
fn rows(lessons: &[Lesson<'_>]) -> Vec<Vec<Vec<f32>>> {
    let mut tasks: Vec<&str> = lessons.iter().map(|lesson| lesson.task).collect();
    tasks.sort_unstable();
    tasks.dedup();
    let row = |lesson: &Lesson<'_>| -> Vec<Vec<f32>> {
        let count = lesson.decisions.len() as f32;
        let decisions = lesson.decisions.iter().enumerate();
        decisions
            .map(|(step, decision)| {
                let mut row = decision.hidden_mean.clone();
                row.extend(decision.statistics);
                row.push(step as f32 / count);
                row.extend(tasks.iter().map(|task| f32::from(u8::from(*task == lesson.task))));
                row
            })
            .collect()
    };
    lessons.iter().map(row).collect()
}

/// Values situations; knows more than the verifier may, and is thrown away after training.
struct Critic {
    network: Network,
}

impl Critic {
    fn fit(
        lessons: &[Lesson<'_>],
        rows: &[Vec<Vec<f32>>],
        is_used: impl Fn(&Lesson<'_>) -> bool,
        seed: u64,
    ) -> Result<Critic> {
        let used = || lessons.iter().zip(rows).filter(|(lesson, _)| is_used(lesson));
        let inputs = || used().flat_map(|(_, rows)| rows.iter().map(Vec::as_slice));
        let labels: Vec<bool> =
            used().flat_map(|(lesson, rows)| rows.iter().map(|_| lesson.is_success)).collect();
        let size = inputs().next().map_or(0, <[f32]>::len);
        let standardisation = Standardisation::of(size, inputs().collect::<Vec<_>>().into_iter());
        // Values are probabilities, so the classes weigh what they weigh.
        let samples = Samples::new(&standardisation, inputs(), &labels, 0.5)?;
        let mut random = StdRng::seed_from_u64(seed);
        let learner = Learner::new(size, HIDDEN_SIZES, &mut random)?;
        let parameters =
            ParamsAdamW { lr: LEARNING_RATE, weight_decay: WEIGHT_DECAY, ..ParamsAdamW::default() };
        let mut optimizer = AdamW::new(learner.variables(), parameters)?;
        for _ in 0..EPOCHS {
            let mut order: Vec<u32> = (0..labels.len() as u32).collect();
            order.shuffle(&mut random);
            pass(&learner, &mut optimizer, &samples, &order, BATCH_SAMPLES)?;
        }
        Ok(Critic { network: learner.network(&standardisation)? })
    }

    fn value(&self, row: &[f32]) -> f64 {
        1.0 / (1.0 + (-f64::from(self.network.logit(row))).exp())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advantages_add_up_to_the_outcome_without_decay() {
        let values = [0.5, 0.75, 0.25];
        let one = accumulate(&values, true, 1.0);
        assert_eq!(one, [0.5, 0.25, 0.75]);
        // Without later values each is its own difference.
        assert_eq!(accumulate(&values, false, 0.0), [0.25, -0.5, -0.25]);
        assert_eq!(accumulate(&values, false, 0.5), [0.25 - 0.3125, -0.5 - 0.125, -0.25]);
        assert!(accumulate(&[], true, 0.5).is_empty());
    }
}
