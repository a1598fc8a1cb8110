//! Fits the ranking of candidates by ridge regression on advantages.
//!
//! No weight may favour lower confidence or a larger distance from the other candidates. Outliers
//! are rare, so an unconstrained regression would give these features random weights, and best-of-N
//! selects outliers (optimizer's curse).

use std::collections::BTreeMap;

use anyhow::Result;

use super::advantage::{Critic, RankingEpisode, advantages, ranking_episodes};
use super::least_squares::NormalEquations;
use super::set::{LayoutKey, TrainingSet};
use super::target;
use crate::{
    CandidateFeatures, FeatureLayout, Ranking, RankingEvidence, ReRankingGain, TargetModel,
    TrainingOptions,
};

/// Number of folds; each one is evaluated by models fitted to the others.
const FOLDS: usize = 5;
/// Minimum number of episodes for a ranking.
pub const EPISODES_MIN: usize = 20;
/// A feature with a smaller scale is constant.
const SCALE_MIN: f64 = 1e-6;

/// The ranking of the given episodes and its cross-fitted gain; `None` if too few of them have
/// decisions.
///
/// Cross-fitting is nested. The weights that evaluate a fold are regressed on the advantages and
/// targets of the other folds. These come from critics and target models that were fitted without
/// the evaluated fold and without the fold that they value.
pub fn fit(
    set: &TrainingSet,
    indices: &[usize],
    options: &TrainingOptions,
) -> Result<Option<(Ranking, RankingEvidence)>> {
    let mut indices = indices.to_vec();
    indices.sort_unstable();
    let used = indices.iter().map(|index| &set.episodes()[*index]);
    let episodes = ranking_episodes(used, FOLDS, options.seed);
    if episodes.len() < EPISODES_MIN {
        return Ok(None);
    }
    let layout = FeatureLayout { action_length: set.action_length() };
    let models = Models::fit(&episodes, options)?;
    let weights_without = |judged: Option<usize>| {
        let used = episodes.iter().filter(|episode| Some(episode.fold) != judged);
        let executed = used.flat_map(|episode| {
            let estimate = models.estimate(episode, judged.unwrap_or(episode.fold));
            let candidates = estimate.candidates.into_iter().map(|one| one.rows()[0].clone());
            candidates.zip(estimate.advantages)
        });
        regress(layout, &executed.collect::<Vec<_>>(), options.ranking_ridge)
    };
    let judged: Vec<Vec<f64>> = (0..FOLDS).map(|fold| weights_without(Some(fold))).collect();
    let gains = |score: &dyn Fn(usize, &[f32]) -> f64| {
        let gains = episodes.iter().map(|episode| {
            let estimate = models.estimate(episode, episode.fold);
            (&episode.episode.start, estimate.gain(|features| score(episode.fold, features)))
        });
        mean_gain(&gains.collect::<Vec<_>>())
    };
    let evidence = RankingEvidence {
        episodes: episodes.len(),
        decisions: episodes.iter().map(|episode| episode.decisions.len()).sum(),
        gain: gains(&|fold, features| {
            judged[fold].iter().zip(features).map(|(one, value)| one * f64::from(*value)).sum()
        }),
        medoid_gain: gains(&|_, features| f64::from(features[layout.nearness()])),
    };
    let mut weights: Vec<f32> = weights_without(None).into_iter().map(|one| one as f32).collect();
    weights[layout.target()].iter_mut().for_each(|one| *one *= options.target_factor as f32);
    let ranking = Ranking::new(layout, weights, target::fit(&episodes, |_| true)?)?;
    Ok(Some((ranking, evidence)))
}

/// For each fold and each pair of folds: the models fitted to all other episodes.
struct Models {
    by_folds: BTreeMap<(usize, usize), (Critic, TargetModel)>,
    decay: f64,
}

impl Models {
    fn fit(episodes: &[RankingEpisode<'_>], options: &TrainingOptions) -> Result<Models> {
        let mut by_folds = BTreeMap::new();
        for (first, second) in (0..FOLDS).flat_map(|one| (one..FOLDS).map(move |two| (one, two))) {
            let is_used = |episode: &RankingEpisode<'_>| ![first, second].contains(&episode.fold);
            let critic = Critic::fit(episodes, is_used, options.seed)?;
            by_folds.insert((first, second), (critic, target::fit(episodes, is_used)?));
        }
        Ok(Models { by_folds, decay: options.advantage_decay })
    }

    /// The estimate for an episode, by models that were fitted without its own fold and without the
    /// fold `other`.
    fn estimate(&self, episode: &RankingEpisode<'_>, other: usize) -> Estimate {
        let (first, second) = (episode.fold.min(other), episode.fold.max(other));
        let (critic, targets) = &self.by_folds[&(first, second)];
        let instruction = &episode.episode.instruction;
        let candidates = episode.decisions.iter().map(|decision| {
            let target = targets.predict(instruction, &decision.tracked, decision.gripper);
            let mut candidates = decision.candidates.clone();
            candidates.set_target(target);
            candidates
        });
        let values = critic.values(episode);
        Estimate {
            candidates: candidates.collect(),
            advantages: advantages(&values, episode.episode.is_success, self.decay),
        }
    }
}

/// The candidates of each decision of an episode, and the advantage of the executed candidate.
struct Estimate {
    candidates: Vec<CandidateFeatures>,
    advantages: Vec<f64>,
}

impl Estimate {
    /// The change if `score` selected the candidate in one decision at a time, summed over the
    /// episode, in percentage points.
    ///
    /// The executed candidate was sampled uniformly. A decision in which it happens to be the best
    /// one is therefore weighted by the number of candidates, which makes the estimate unbiased for
    /// a single decision.
    fn gain(&self, score: impl Fn(&[f32]) -> f64) -> f64 {
        let decision = |(candidates, advantage): (&CandidateFeatures, &f64)| {
            let scores: Vec<f64> = candidates.rows().iter().map(|row| score(row)).collect();
            let largest = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let ties = scores.iter().filter(|score| **score == largest).count() as f64;
            let is_best = f64::from(u8::from(scores[0] == largest));
            (is_best * scores.len() as f64 / ties - 1.0) * advantage * 100.0
        };
        self.candidates.iter().zip(&self.advantages).map(decision).sum()
    }
}

/// The mean gain of the episodes with a cluster-robust standard error; episodes with the same
/// layout are one cluster.
fn mean_gain(episodes: &[(&LayoutKey, f64)]) -> ReRankingGain {
    let count = episodes.len() as f64;
    let mean = episodes.iter().map(|(_, gain)| gain).sum::<f64>() / count;
    let mut clusters: BTreeMap<&LayoutKey, f64> = BTreeMap::new();
    for (start, gain) in episodes {
        *clusters.entry(start).or_default() += gain - mean;
    }
    let groups = clusters.len() as f64;
    let squares: f64 = clusters.values().map(|sum| sum * sum).sum();
    let standard_error = (squares * groups / (groups - 1.0)).sqrt() / count;
    ReRankingGain { percentage_points: mean, standard_error }
}

/// Ridge regression of advantages on the executed candidates' standardised features.
fn regress(layout: FeatureLayout, samples: &[(Vec<f32>, f64)], ridge: f64) -> Vec<f64> {
    let count = samples.len().max(1) as f64;
    let scale = |index: usize| {
        let squares = samples.iter().map(|(features, _)| f64::from(features[index]).powi(2));
        let scale = (squares.sum::<f64>() / count).sqrt();
        // An infinite scale gives a constant feature no weight.
        if scale < SCALE_MIN { f64::INFINITY } else { scale }
    };
    let scales: Vec<f64> = (0..layout.length()).map(scale).collect();
    let standardised = samples.iter().map(|(features, advantage)| {
        let values = features.iter().zip(&scales);
        (values.map(|(value, scale)| f64::from(*value) / scale).collect(), *advantage)
    });
    let mut equations = NormalEquations::of(layout.length(), standardised);
    (0..layout.length()).for_each(|index| equations.add_ridge(index, ridge));
    let weights = equations.solve_with_signs(|index| layout.deviations().contains(&index));
    weights.iter().zip(scales).map(|(weight, scale)| weight / scale).collect()
}

#[cfg(test)]
mod tests;
