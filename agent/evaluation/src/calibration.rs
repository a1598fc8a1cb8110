//! Calibration: reliability bins, calibration error, Brier score. A calibrated score of 0.7 means 70 % success.
//!
//! The verifier is trained with class weights, so its probabilities are those of balanced classes. If successes are not
//! half of all samples, its logits are shifted by the log odds of the classes. This changes no ranking, but it changes
//! these metrics.

/// The usual number of bins of a reliability diagram.
pub const BINS: usize = 15;

/// One bar of a reliability diagram: the samples whose probability lies in `low..high` (the last bin includes 1).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ReliabilityBin {
    /// Lower end of the bin.
    pub low: f64,
    /// Upper end of the bin.
    pub high: f64,
    /// Samples in the bin.
    pub samples: u64,
    /// Their mean predicted probability; 0 when the bin is empty.
    pub probability_mean: f64,
    /// Their share of successes; 0 when the bin is empty.
    pub success_rate: f64,
}

/// Sorts samples into bins of equal width.
pub fn reliability(probabilities: &[f32], labels: &[bool], bins: usize) -> Vec<ReliabilityBin> {
    assert_eq!(probabilities.len(), labels.len(), "one label per probability");
    assert!(bins > 0, "a reliability diagram needs bins");
    let mut counts = vec![(0_u64, 0.0, 0_u64); bins];
    for (probability, label) in probabilities.iter().zip(labels) {
        let probability = f64::from(*probability);
        assert!((0.0..=1.0).contains(&probability), "a probability is in 0..=1, got {probability}");
        let (samples, sum, successes) =
            &mut counts[((probability * bins as f64) as usize).min(bins - 1)];
        *samples += 1;
        *sum += probability;
        *successes += u64::from(*label);
    }
    let bin = |(index, (samples, sum, successes)): (usize, (u64, f64, u64))| {
        let count = samples.max(1) as f64;
        ReliabilityBin {
            low: index as f64 / bins as f64,
            high: (index + 1) as f64 / bins as f64,
            samples,
            probability_mean: sum / count,
            success_rate: successes as f64 / count,
        }
    };
    counts.into_iter().enumerate().map(bin).collect()
}

/// The mean gap between predicted and observed rate, with bins weighted by their samples; `None` without samples.
pub fn calibration_error(bins: &[ReliabilityBin]) -> Option<f64> {
    let samples: u64 = bins.iter().map(|bin| bin.samples).sum();
    let gaps =
        bins.iter().map(|bin| bin.samples as f64 * (bin.probability_mean - bin.success_rate).abs());
    (samples > 0).then(|| gaps.sum::<f64>() / samples as f64)
}

/// The mean squared difference between probability and outcome; `None` without samples.
pub fn brier_score(probabilities: &[f32], labels: &[bool]) -> Option<f64> {
    assert_eq!(probabilities.len(), labels.len(), "one label per probability");
    let squares = probabilities.iter().zip(labels);
    let squares = squares.map(|(probability, label)| {
        (f64::from(*probability) - f64::from(u8::from(*label))).powi(2)
    });
    (!labels.is_empty()).then(|| squares.sum::<f64>() / labels.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_hold_every_sample_once_and_one_is_in_the_last() {
        let bins = reliability(&[0.0, 0.1, 0.5, 0.99, 1.0], &[false, true, true, true, false], 4);
        let samples: Vec<u64> = bins.iter().map(|bin| bin.samples).collect();
        assert_eq!(samples, [2, 0, 1, 2]);
        assert_eq!((bins[0].low, bins[0].high, bins[0].success_rate), (0.0, 0.25, 0.5));
        assert!((bins[3].probability_mean - 0.995).abs() < 1e-6);
    }

    #[test]
    fn calibration_error_weighs_bins_by_their_samples() {
        // Bin 0: predicted 0.25, observed 0.5; bin 1: predicted 0.75, observed 1. The gap is 0.25 in both.
        let bins = reliability(&[0.25, 0.25, 0.75, 0.75], &[true, false, true, true], 2);
        assert!((calibration_error(&bins).expect("samples") - 0.25).abs() < 1e-12);
        let bins = reliability(&[0.25, 0.75, 0.75, 0.75], &[true, true, true, true], 2);
        assert!(
            (calibration_error(&bins).expect("samples") - (0.75 + 3.0 * 0.25) / 4.0).abs() < 1e-12
        );
        assert_eq!(calibration_error(&reliability(&[], &[], 2)), None);
    }

    #[test]
    fn brier_score_is_the_mean_square() {
        assert_eq!(brier_score(&[1.0, 0.0, 0.5], &[true, false, true]), Some(0.25 / 3.0));
        assert_eq!(brier_score(&[], &[]), None);
    }
}
