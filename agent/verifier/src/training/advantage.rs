//! What each decision of an episode changed: the advantage of the executed action, by TD(lambda).
//!
//! The outcome alone is a poor label for one of sixty actions. A critic that knows the situation before and after tells
//! earlier what an action did. Its values are cross-fitted: no outcome of an episode's own fold shapes its values.

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

/// The critic is smaller than the verifier: it must not remember episodes.
const HIDDEN_SIZES: [usize; 2] = [64, 32];
/// Passes over the decisions; more begin to overfit.
const EPOCHS: usize = 4;
const BATCH_SAMPLES: usize = 256;
const LEARNING_RATE: f64 = 3e-4;
const WEIGHT_DECAY: f64 = 0.1;

/// An episode whose decisions were between several candidates.
pub struct RankingEpisode<'a> {
    /// The episode.
    pub episode: &'a TrainingEpisode,
    /// Its decisions, one for each sample.
    pub decisions: &'a [DecisionSample],
    /// The part of the episodes that it belongs to.
    pub fold: usize,
}

/// The episodes with decisions, dealt to folds by their layouts.
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

/// The advantage of every executed action, as changes of the probability of success, from the values of the situations.
///
/// delta_t = V(t + 1) - V(t), the last one with the outcome in place of V; A_t = delta_t + decay A_(t + 1).
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

/// Values situations; knows more than the verifier may, and is thrown away after training.
pub struct Critic {
    network: Network,
    tasks: Vec<TaskId>,
}

impl Critic {
    /// A critic of situations like those of `all`, fitted to the episodes in use.
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
        // Values are probabilities, so both classes weigh the same.
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

    /// The probability of success before each decision of an episode.
    pub fn values(&self, episode: &RankingEpisode<'_>) -> Vec<f64> {
        let inputs = inputs(episode, &self.tasks);
        let value = |row| 1.0 / (1.0 + (-f64::from(self.network.logit(row))).exp());
        inputs.iter().map(|row| value(row.as_slice())).collect()
    }
}

/// What the critic reads of each decision: hidden state, flags of the simulator, step, task.
///
/// The step counts in parts of the task's horizon. In parts of the episode's own length it would tell the outcome of
/// every task that ends on success.
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
        // Without later values each is its own difference.
        assert_eq!(advantages(&values, false, 0.0), [0.25, -0.5, -0.25]);
        assert_eq!(advantages(&values, false, 0.5), [0.25 - 0.3125, -0.5 - 0.125, -0.25]);
        assert!(advantages(&[], true, 0.5).is_empty());
    }

    #[test]
    fn an_episode_that_ends_early_looks_to_the_critic_like_one_that_goes_on() {
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
        // Hidden state of two values, then the flags, then the third of 60 steps.
        assert_eq!(inputs(&long)[2][2 + crate::training::STATISTICS], 2.0 / 60.0);
    }
}
