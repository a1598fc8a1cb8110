//! Rankings of synthetic episodes with and without a signal.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::training::TrainingEpisode;
use crate::training::set::tests::episode;
use crate::training::tests::decision;

/// Episodes of 20 decisions among five candidates. Success becomes more likely with the confidence
/// of part 6 of the executed candidates. Part 2 varies as much and has no effect; a low part 4
/// helps, which the sign constraint excludes.
fn made_up(episodes: usize, strength: f64, seed: u64) -> Vec<TrainingEpisode> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut one = |number: usize| {
        let mut sum = 0.0;
        let mut made_up = || {
            let mut candidate = || {
                let mut confidence = vec![0.0; 16];
                confidence[2] = random.random_range(-2.0..0.0_f32);
                confidence[4] = random.random_range(-1.0..0.0_f32);
                confidence[6] = random.random_range(-2.0..0.0_f32);
                confidence
            };
            let candidates: Vec<Vec<f32>> = (0..5).map(|_| candidate()).collect();
            let decision = decision(&candidates);
            let executed = &decision.candidates.rows()[0];
            sum += f64::from(executed[6] - executed[4]);
            decision
        };
        let decisions = (0..20).map(|_| made_up()).collect();
        let is_success = random.random_bool(1.0 / (1.0 + (-strength * sum).exp()));
        TrainingEpisode {
            hidden: vec![0.5; 40],
            steps: (0..20).collect(),
            steps_total: 20,
            decisions: Some(decisions),
            ..episode(&format!("episode {number:04}"), "stack", number as u64, is_success)
        }
    };
    (0..episodes).map(&mut one).collect()
}

fn fit_all(episodes: Vec<TrainingEpisode>) -> Option<(Ranking, RankingEvidence)> {
    let set = TrainingSet::new(2, 7, episodes).expect("whole");
    let all: Vec<usize> = (0..set.episodes().len()).collect();
    fit(&set, &all, &TrainingOptions::default()).expect("it can be fitted")
}

#[test]
fn a_feature_with_an_effect_is_found() {
    let (ranking, evidence) = fit_all(made_up(400, 0.7, 7)).expect("enough episodes");
    let weights = ranking.weights();
    assert!(weights[6] > 0.02 && weights[2].abs() < 0.4 * weights[6], "{weights:?}");
    assert_eq!((weights[4], weights[16]), (0.0, 0.0));
    let ReRankingGain { percentage_points, standard_error } = evidence.gain;
    assert!(percentage_points > 3.0 * standard_error && percentage_points > 10.0, "{evidence:?}");
    // All actions are equal, so that every candidate is a medoid.
    assert!(evidence.medoid_gain.percentage_points.abs() < 1e-9, "{evidence:?}");
    assert_eq!((evidence.episodes, evidence.decisions), (400, 8000));
}

#[test]
fn no_gain_is_reported_without_a_signal() {
    let gains: Vec<ReRankingGain> = (0..3)
        .map(|seed| fit_all(made_up(60, 0.0, seed)).expect("enough episodes").1.gain)
        .collect();
    let mean = gains.iter().map(|gain| gain.percentage_points).sum::<f64>() / 3.0;
    let squares: f64 = gains.iter().map(|gain| gain.standard_error.powi(2)).sum();
    assert!(mean.abs() < 2.5 * squares.sqrt() / 3.0, "{gains:?}");
    assert!(fit_all(made_up(19, 0.5, 7)).is_none());
}

#[test]
fn outcomes_of_a_fold_do_not_affect_the_weights_that_evaluate_it() {
    let episodes = made_up(30, 0.7, 3);
    let set = TrainingSet::new(2, 7, episodes).expect("whole");
    let options = TrainingOptions::default();
    let folds = ranking_episodes(set.episodes().iter(), FOLDS, options.seed);
    let turned: Vec<TrainingEpisode> = folds
        .iter()
        .map(|one| {
            let is_success = one.episode.is_success != (one.fold == 2);
            TrainingEpisode { is_success, ..one.episode.clone() }
        })
        .collect();
    let turned = TrainingSet::new(2, 7, turned).expect("whole");
    let estimate = |set: &TrainingSet, judged: usize| -> Vec<Vec<f64>> {
        let episodes = ranking_episodes(set.episodes().iter(), FOLDS, options.seed);
        let models = Models::fit(&episodes, &options).expect("models");
        let others = episodes.iter().filter(|episode| episode.fold != 2);
        others.map(|episode| models.estimate(episode, judged).advantages).collect()
    };
    assert_eq!(estimate(&set, 2), estimate(&turned, 2), "fold 2 is evaluated and not used");
    assert_ne!(estimate(&set, 1), estimate(&turned, 1), "fold 2 is used");
}

#[test]
fn episodes_of_one_layout_count_as_one_cluster() {
    let starts: Vec<LayoutKey> =
        (0..4).map(|seed| episode("one", "stack", seed, true).start).collect();
    let gains = [1.0, 3.0, -2.0, 6.0];
    let single: Vec<_> = starts.iter().zip(gains).collect();
    let gain = mean_gain(&single);
    assert_eq!(gain.percentage_points, 2.0);
    // The squares are 1, 1, 16 and 16 for four clusters: 34 / 3 / 4.
    assert!((gain.standard_error - (34.0_f64 / 12.0).sqrt()).abs() < 1e-12);
    // Each episode is repeated with the same gain: the mean is not known more precisely.
    let repeated: Vec<_> = single.iter().chain(&single).copied().collect();
    assert!((mean_gain(&repeated).standard_error - gain.standard_error).abs() < 1e-12);
}
