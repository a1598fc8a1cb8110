//! The advantage of each executed action by TD(lambda).
//!
//! The outcome alone is a noisy label for one of sixty actions. A critic that values the situations
//! before and after an action attributes changes to it. The values are cross-fitted: the critic of
//! an episode was fitted without the outcomes of its fold.

use anyhow::Result;
use candle_nn::optim::{AdamW, Optimizer, ParamsAdamW};
use decision::TaskId;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::decision_sample::DecisionSample;
use super::learner::{Learner, Samples};
use super::set::TrainingEpisode;
use super::{pass, split};
use crate::{Network, Standardisation};

/// The critic is smaller than the verifier, so that it does not memorise episodes.
const HIDDEN_SIZES: [usize; 2] = [64, 32];
/// Passes over the decisions; more passes overfit.
const EPOCHS: usize = 4;
const BATCH_SAMPLES: usize = 256;
const LEARNING_RATE: f64 = 3e-4;
const WEIGHT_DECAY: f64 = 0.1;

/// An episode whose decisions had several candidates.
pub struct RankingEpisode<'a> {
    /// The episode.
    pub episode: &'a TrainingEpisode,
    /// One decision per sample.
    pub decisions: &'a [DecisionSample],
    /// The fold of the episode.
    pub fold: usize,
}

/// The episodes with decisions, assigned to folds by their layouts.
pub fn ranking_episodes<'a>(
    episodes: impl Iterator<Item = &'a TrainingEpisode>,
    folds: usize,
    seed: u64,
) -> Vec<RankingEpisode<'a>> {
    let with_decisions = episodes.filter_map(|episode| {
        let decisions = episode.decisions.as_deref().filter(|decisions| !decisions.is_empty())?;
        Some(RankingEpisode { episode, decisions, fold: 0 })
    });
    let mut episodes: Vec<RankingEpisode<'_>> = with_decisions.collect();
    let folds = split::folds(episodes.iter().map(|one| &one.episode.start), folds, seed);
    episodes.iter_mut().zip(folds).for_each(|(episode, fold)| episode.fold = fold);
    episodes
}

/// The advantage of every executed action as a change of the success probability, computed from the
/// values of the situations.
///
/// delta_t = V(t + 1) - V(t), where the outcome replaces the last V(t + 1);
/// A_t = delta_t + decay A_(t + 1).
pub fn advantages(values: &[f64], is_success: bool, decay: f64) -> Vec<f64> {
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

/// Estimates the values of situations. It uses simulator state that the verifier must not use, and
/// is discarded after training.
pub struct Critic {
    network: Network,
    tasks: Vec<TaskId>,
}

impl Critic {
    /// Fits a critic to the used episodes; `all` determines the tasks it distinguishes.
    pub fn fit(
        all: &[RankingEpisode<'_>],
        is_used: impl Fn(&RankingEpisode<'_>) -> bool,
        seed: u64,
    ) -> Result<Critic> {
        let mut tasks: Vec<TaskId> = all.iter().map(|one| one.episode.start.task.clone()).collect();
        tasks.sort();
        tasks.dedup();
        let used = || all.iter().filter(|one| is_used(one));
        let inputs: Vec<Vec<f32>> = used().flat_map(|one| inputs(one, &tasks)).collect();
        let labels = used().flat_map(|one| one.decisions.iter().map(|_| one.episode.is_success));
        let labels: Vec<bool> = labels.collect();
        let rows = || inputs.iter().map(Vec::as_slice);
        let size = inputs.first().map_or(0, Vec::len);
        let standardisation = Standardisation::of(size, rows());
        // Values are probabilities, so both classes have the same weight.
        let samples = Samples::new(&standardisation, rows(), &labels, 0.5)?;
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let learner = Learner::new(size, HIDDEN_SIZES, &mut random)?;
        let parameters =
            ParamsAdamW { lr: LEARNING_RATE, weight_decay: WEIGHT_DECAY, ..ParamsAdamW::default() };
        let mut optimizer = AdamW::new(learner.variables(), parameters)?;
        for _ in 0..EPOCHS {
            let mut order: Vec<u32> = (0..labels.len() as u32).collect();
            order.shuffle(&mut random);
            pass(&learner, &mut optimizer, &samples, &order, BATCH_SAMPLES)?;
        }
        Ok(Critic { network: learner.network(&standardisation)?, tasks })
    }

    /// The success probability before each decision of an episode.
    pub fn values(&self, episode: &RankingEpisode<'_>) -> Vec<f64> {
        let inputs = inputs(episode, &self.tasks);
        let value = |row| 1.0 / (1.0 + (-f64::from(self.network.logit(row))).exp());
        inputs.iter().map(|row| value(row.as_slice())).collect()
    }
}

/// The critic's inputs for each decision: hidden state, simulator flags, step, task.
///
/// The step is relative to the task's horizon. Relative to the episode's own length it would reveal
/// the outcome of every task that ends on success.
fn inputs(episode: &RankingEpisode<'_>, tasks: &[TaskId]) -> Vec<Vec<f32>> {
    let RankingEpisode { episode, decisions, .. } = episode;
    let row = |(decision, step): (&DecisionSample, &usize)| {
        let mut row = decision.hidden_mean.clone();
        row.extend(decision.statistics);
        row.push(*step as f32 / episode.steps_max as f32);
        row.extend(tasks.iter().map(|task| f32::from(u8::from(*task == episode.start.task))));
        row
    };
    decisions.iter().zip(&episode.steps).map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::set::tests::episode;
    use crate::training::tests::decision;

    #[test]
    fn advantages_add_up_to_the_outcome_without_decay() {
        let values = [0.5, 0.75, 0.25];
        let one = advantages(&values, true, 1.0);
        assert_eq!(one, [0.5, 0.25, 0.75]);
        // Without later values, each advantage is only its own difference.
        assert_eq!(advantages(&values, false, 0.0), [0.25, -0.5, -0.25]);
        assert_eq!(advantages(&values, false, 0.5), [0.25 - 0.3125, -0.5 - 0.125, -0.25]);
        assert!(advantages(&[], true, 0.5).is_empty());
    }

    #[test]
    fn the_critic_cannot_see_when_an_episode_ends() {
        let long = episode("long", "stack", 1, false);
        let mut short = episode("short", "stack", 2, true);
        short.steps.truncate(2);
        short.steps_total = 2;
        let decisions = vec![decision(&[vec![0.0; 16]]); 3];
        let inputs = |episode: &TrainingEpisode| {
            let count = episode.steps.len();
            let episode = RankingEpisode { episode, decisions: &decisions[..count], fold: 0 };
            inputs(&episode, std::slice::from_ref(&long.start.task))
        };
        assert_eq!(inputs(&short), inputs(&long)[..2]);
        // Hidden state of two values, then the flags, then step 2 of 60.
        assert_eq!(inputs(&long)[2][2 + crate::training::STATISTICS], 2.0 / 60.0);
    }
}
