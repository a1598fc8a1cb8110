//! Intervals and comparisons for success rates: Wilson, paired bootstrap, headroom, AUROC.

use rand::Rng;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// The two-sided 95 % point of the normal distribution: every interval of this project is a 95 % interval.
const NORMAL_95: f64 = 1.959_963_984_540_054;

/// Resamples of a bootstrap that is to be reported; fewer make the ends of the interval wobble in the third digit.
pub const RESAMPLES: usize = 10_000;

/// A 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// Successes among trials.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Rate {
    /// Trials that succeeded.
    pub successes: u64,
    /// All trials.
    pub trials: u64,
}

impl Rate {
    /// Counts outcomes.
    pub fn of(outcomes: impl IntoIterator<Item = bool>) -> Rate {
        outcomes.into_iter().fold(Rate::default(), |rate, success| Rate {
            successes: rate.successes + u64::from(success),
            trials: rate.trials + 1,
        })
    }

    /// The share of successes; `None` without trials.
    pub fn value(self) -> Option<f64> {
        (self.trials > 0).then(|| self.successes as f64 / self.trials as f64)
    }

    /// The Wilson interval of this rate; everything is possible without trials.
    pub fn interval(self) -> Interval {
        wilson(self.successes, self.trials)
    }
}

/// Wilson's 95 % interval for a binomial rate: honest also near 0 and 1 and for few trials.
pub fn wilson(successes: u64, trials: u64) -> Interval {
    assert!(successes <= trials, "{successes} successes of {trials} trials");
    if trials == 0 {
        return Interval { low: 0.0, high: 1.0 };
    }
    let count = trials as f64;
    let rate = successes as f64 / count;
    let square = NORMAL_95 * NORMAL_95 / count;
    let centre = (rate + square / 2.0) / (1.0 + square);
    let half =
        NORMAL_95 * (rate * (1.0 - rate) / count + square / (4.0 * count)).sqrt() / (1.0 + square);
    // At 0 and 1 the ends are exact by algebra but not in floating point.
    let low = if successes == 0 { 0.0 } else { centre - half };
    let high = if successes == trials { 1.0 } else { centre + half };
    Interval { low, high }
}

/// A paired difference of two strategies, averaged over tasks, with its bootstrap interval.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Gain {
    /// Average of the per-task mean differences.
    pub mean: f64,
    /// Percentile bootstrap interval of the mean.
    pub interval: Interval,
    /// Paired episodes over all tasks.
    pub pairs: usize,
}

/// The gain over paired episodes: `differences` holds one list per task of (success with a) - (success with b).
///
/// Pairs are drawn with replacement within each task, so every resample has the tasks' own sizes and each task weighs the
/// same in the average, however many episodes it has. `None` when there is no task or a task has no pair. Few pairs
/// that all agree give an interval of no width: the bootstrap knows no difference that it never saw.
pub fn paired_bootstrap(differences: &[Vec<f64>], resamples: usize, seed: u64) -> Option<Gain> {
    assert!(resamples > 0, "a bootstrap needs resamples");
    if differences.is_empty() || differences.iter().any(Vec::is_empty) {
        return None;
    }
    let tasks = differences.len() as f64;
    let task_mean = |task: &Vec<f64>| task.iter().sum::<f64>() / task.len() as f64;
    let mean = differences.iter().map(task_mean).sum::<f64>() / tasks;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut resample = || {
        let sums = differences.iter().map(|task| {
            let drawn: f64 =
                (0..task.len()).map(|_| task[random.random_range(0..task.len())]).sum();
            drawn / task.len() as f64
        });
        sums.sum::<f64>() / tasks
    };
    let mut means: Vec<f64> = (0..resamples).map(|_| resample()).collect();
    means.sort_by(f64::total_cmp);
    let interval = Interval { low: quantile(&means, 0.025), high: quantile(&means, 0.975) };
    Some(Gain { mean, interval, pairs: differences.iter().map(Vec::len).sum() })
}

/// The quantile of sorted values, linear between neighbours.
pub fn quantile(sorted: &[f64], share: f64) -> f64 {
    assert!(!sorted.is_empty(), "a quantile needs values");
    assert!((0.0..=1.0).contains(&share), "a quantile's share is in 0..=1, got {share}");
    let place = share * (sorted.len() - 1) as f64;
    let below = sorted[place.floor() as usize];
    let above = sorted[place.ceil() as usize];
    below + (above - below) * place.fract()
}

/// The part of the way from `sample` to `oracle` that `chosen` has gone; `None` when the oracle is no better than a sample.
pub fn headroom_fraction(sample: f64, chosen: f64, oracle: f64) -> Option<f64> {
    (oracle > sample).then(|| (chosen - sample) / (oracle - sample))
}

/// Area under the ROC curve: the chance that a positive scores above a negative, ties counting half.
///
/// `None` when one class is missing. Ties share the mean of their ranks.
pub fn auroc(scores: &[f32], labels: &[bool]) -> Option<f64> {
    assert_eq!(scores.len(), labels.len(), "one label per score");
    let positives = labels.iter().filter(|label| **label).count() as f64;
    let negatives = labels.len() as f64 - positives;
    if positives == 0.0 || negatives == 0.0 {
        return None;
    }
    let mut order: Vec<usize> = (0..scores.len()).collect();
    order.sort_by(|a, b| scores[*a].total_cmp(&scores[*b]));
    let mut positive_ranks = 0.0;
    let mut ranked = 0;
    for ties in order.chunk_by(|a, b| scores[*a] == scores[*b]) {
        let rank = ranked as f64 + (ties.len() as f64 + 1.0) / 2.0;
        positive_ranks += rank * ties.iter().filter(|index| labels[**index]).count() as f64;
        ranked += ties.len();
    }
    Some((positive_ranks - positives * (positives + 1.0) / 2.0) / (positives * negatives))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_wilson(successes: u64, trials: u64, low: f64, high: f64) {
        let interval = wilson(successes, trials);
        let near = |a: f64, b: f64| (a - b).abs() < 5e-5;
        assert!(
            near(interval.low, low) && near(interval.high, high),
            "{successes}/{trials}: {interval:?}"
        );
    }

    #[test]
    fn wilson_equals_published_intervals() {
        // Newcombe, "Two-sided confidence intervals for the single proportion", Statistics in Medicine 17 (1998),
        // table I, method 3.
        check_wilson(81, 263, 0.2553, 0.3662);
        check_wilson(15, 148, 0.0624, 0.1605);
        check_wilson(0, 20, 0.0, 0.1611);
        check_wilson(1, 29, 0.0061, 0.1718);
        // The mirror image of none in twenty.
        check_wilson(20, 20, 1.0 - 0.1611, 1.0);
        check_wilson(0, 0, 0.0, 1.0);
    }

    #[test]
    fn rates_count_outcomes() {
        let rate = Rate::of([true, false, true, true]);
        assert_eq!(rate, Rate { successes: 3, trials: 4 });
        assert_eq!(rate.value(), Some(0.75));
        assert_eq!(rate.interval(), wilson(3, 4));
        assert_eq!(Rate::of([]).value(), None);
    }

    #[test]
    fn bootstrap_of_one_task_matches_the_normal_interval() {
        // 30 gains, 10 losses and 60 ties: mean 0.2, variance 0.36, standard error 0.06.
        let task: Vec<f64> = (0..100)
            .map(|i| {
                if i < 30 {
                    1.0
                } else if i < 40 {
                    -1.0
                } else {
                    0.0
                }
            })
            .collect();
        let gain = paired_bootstrap(&[task], RESAMPLES, 7).expect("pairs");
        assert!((gain.mean - 0.2).abs() < 1e-12);
        assert!((gain.interval.low - (0.2 - 1.96 * 0.06)).abs() < 0.011, "{gain:?}");
        assert!((gain.interval.high - (0.2 + 1.96 * 0.06)).abs() < 0.011, "{gain:?}");
        assert_eq!(gain.pairs, 100);
    }

    #[test]
    fn bootstrap_weighs_tasks_alike_and_never_mixes_them() {
        // Between tasks there is a difference and within a task none: resampling within tasks has nothing to vary.
        let gain = paired_bootstrap(&[vec![1.0; 10], vec![0.0; 1000]], 1000, 1).expect("pairs");
        assert_eq!(
            gain,
            Gain { mean: 0.5, interval: Interval { low: 0.5, high: 0.5 }, pairs: 1010 }
        );
    }

    #[test]
    fn same_seed_same_interval() {
        let tasks = [vec![1.0, 0.0, 0.0, -1.0, 1.0, 1.0]];
        let first = paired_bootstrap(&tasks, 1000, 3);
        assert_eq!(first, paired_bootstrap(&tasks, 1000, 3));
        assert_ne!(first, paired_bootstrap(&tasks, 10, 4));
        assert_eq!(paired_bootstrap(&[], 10, 0), None);
        assert_eq!(paired_bootstrap(&[vec![1.0], vec![]], 10, 0), None);
    }

    #[test]
    fn quantiles_lie_between_neighbours() {
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.0), 1.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.5), 2.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 1.0), 4.0);
    }

    #[test]
    fn headroom_is_the_part_of_the_way_to_the_oracle() {
        let near =
            |found: Option<f64>, expected: f64| (found.expect("headroom") - expected).abs() < 1e-12;
        assert!(near(headroom_fraction(0.6, 0.7, 1.0), 0.25));
        assert!(near(headroom_fraction(0.6, 0.5, 1.0), -0.25));
        assert_eq!(headroom_fraction(0.6, 0.7, 0.6), None);
    }

    #[test]
    fn auroc_counts_pairs_with_ties_as_half() {
        let by_pairs = |scores: &[f32], labels: &[bool]| {
            let (mut wins, mut pairs) = (0.0, 0.0);
            for i in 0..scores.len() {
                for j in 0..scores.len() {
                    if labels[i] && !labels[j] {
                        pairs += 1.0;
                        wins += f64::from(u8::from(scores[i] > scores[j]));
                        wins += 0.5 * f64::from(u8::from(scores[i] == scores[j]));
                    }
                }
            }
            wins / pairs
        };
        // scikit-learn's own example: roc_auc_score([0, 0, 1, 1], [0.1, 0.4, 0.35, 0.8]) is 0.75.
        assert_eq!(auroc(&[0.1, 0.4, 0.35, 0.8], &[false, false, true, true]), Some(0.75));
        assert_eq!(auroc(&[0.3; 4], &[false, false, true, true]), Some(0.5));
        assert_eq!(auroc(&[0.1, 0.2], &[true, true]), None);
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let scores: Vec<f32> = (0..60).map(|_| random.random_range(0..12) as f32).collect();
        let labels: Vec<bool> = (0..60).map(|_| random.random_bool(0.4)).collect();
        let found = auroc(&scores, &labels).expect("both classes");
        assert!((found - by_pairs(&scores, &labels)).abs() < 1e-12);
    }
}
