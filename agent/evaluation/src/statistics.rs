//! Wilson intervals, quantiles, the area under the ROC curve.

/// The two-sided 95 % quantile of the normal distribution: every interval of this project is a 95 % interval.
const NORMAL_95: f64 = 1.959_963_984_540_054;

/// A 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Interval {
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl Interval {
    /// The interval of a rate without observations.
    pub const UNKNOWN: Interval = Interval { low: 0.0, high: 1.0 };

    /// Whether the interval contains a value.
    pub fn contains(self, value: f64) -> bool {
        (self.low..=self.high).contains(&value)
    }
}

/// Wilson's 95 % interval for the rate observed in `trials` trials. It is accurate near 0 and 1 and for few trials.
///
/// `trials` need not be a whole number: for a clustered sample it is the effective sample size.
pub fn wilson(rate: f64, trials: f64) -> Interval {
    assert!((0.0..=1.0).contains(&rate), "a rate is in 0..=1, got {rate}");
    if trials <= 0.0 {
        return Interval::UNKNOWN;
    }
    let square = NORMAL_95 * NORMAL_95 / trials;
    let centre = (rate + square / 2.0) / (1.0 + square);
    let half = NORMAL_95 * (rate * (1.0 - rate) / trials + square / (4.0 * trials)).sqrt()
        / (1.0 + square);
    // At 0 and 1 the ends are exact by algebra but not in floating point.
    let low = if rate == 0.0 { 0.0 } else { centre - half };
    let high = if rate == 1.0 { 1.0 } else { centre + half };
    Interval { low, high }
}

/// The quantile of sorted values, interpolated linearly; NaN without values.
pub fn quantile(sorted: &[f64], share: f64) -> f64 {
    assert!((0.0..=1.0).contains(&share), "a quantile's share is in 0..=1, got {share}");
    let place = share * sorted.len().saturating_sub(1) as f64;
    let value = |index: f64| sorted.get(index as usize).copied().unwrap_or(f64::NAN);
    let (below, above) = (value(place.floor()), value(place.ceil()));
    below + (above - below) * place.fract()
}

/// Area under the ROC curve: the probability that a positive scores above a negative, with ties counted as half.
///
/// `None` if a class is missing. Ties share the mean of their ranks.
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
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn check_wilson(successes: u64, trials: u64, low: f64, high: f64) {
        let interval = wilson(successes as f64 / trials as f64, trials as f64);
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
        // Symmetric to 0 of 20.
        check_wilson(20, 20, 1.0 - 0.1611, 1.0);
        assert_eq!(wilson(0.0, 0.0), Interval::UNKNOWN);
    }

    #[test]
    fn a_rate_of_none_or_of_all_has_an_interval_of_some_width() {
        for trials in 1..=24 {
            let (none, all) = (wilson(0.0, f64::from(trials)), wilson(1.0, f64::from(trials)));
            assert_eq!((none.low, all.high), (0.0, 1.0));
            assert!(none.high > 0.1 && (none.high - (1.0 - all.low)).abs() < 1e-12, "{trials}");
        }
    }

    #[test]
    fn quantiles_lie_between_neighbours() {
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.0), 1.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.5), 2.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 1.0), 4.0);
        // numpy.quantile([3, 5, 8, 13], 0.95), whose method is linear, is 12.25.
        assert!((quantile(&[3.0, 5.0, 8.0, 13.0], 0.95) - 12.25).abs() < 1e-12);
        assert_eq!(quantile(&[7.0], 0.95), 7.0);
        assert!(quantile(&[], 0.5).is_nan());
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
