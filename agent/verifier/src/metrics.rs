//! How well a verifier separates successes from failures on held-out episodes.

use std::collections::BTreeMap;

use decision::probability;
use evaluation::calibration::{BINS, ReliabilityBin, brier_score, calibration_error, reliability};
use evaluation::statistics::auroc;
use serde::{Deserialize, Serialize};

/// Number of steps in the first and in the last phase of an episode.
pub const PHASE_STEPS: usize = 10;

/// Scored samples with their labels; all lists have the same length.
#[derive(Clone, Debug, Default)]
pub struct ScoredSamples {
    /// The verifier's logits.
    pub logits: Vec<f32>,
    /// Whether the sample's episode succeeded.
    pub labels: Vec<bool>,
    /// The sample's task, with its variant unless that is the default.
    pub tasks: Vec<String>,
    /// The sample's control step, from 0.
    pub steps: Vec<usize>,
    /// The number of control steps of the sample's episode.
    pub episode_steps: Vec<usize>,
}

/// Quality on samples of held-out episodes, which were used neither for fitting nor for selection.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Metrics {
    /// Class-weighted cross-entropy, in nats; `None` without samples.
    pub loss: Option<f64>,
    /// All steps.
    pub auroc: Discrimination,
    /// The first [`PHASE_STEPS`] steps, in which a good choice has the largest effect.
    pub auroc_first_steps: Discrimination,
    /// The steps in between.
    pub auroc_middle_steps: Discrimination,
    /// The last [`PHASE_STEPS`] steps, where the outcome is often visible.
    pub auroc_last_steps: Discrimination,
    /// Mean squared difference between probability and outcome.
    pub brier_score: Option<f64>,
    /// Expected calibration error, computed from `reliability`.
    pub calibration_error: Option<f64>,
    /// The reliability diagram.
    pub reliability: Vec<ReliabilityBin>,
}

/// AUROC in three variants; `None` if a class is missing.
///
/// The pooled value is misleading: it rises if the verifier only separates easy from hard tasks,
/// which ranks no candidate of a decision. The macro average avoids that, but still rewards
/// recognising an easy layout.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Discrimination {
    /// All samples of all tasks.
    pub pooled: Option<f64>,
    /// The mean over the tasks that have a value.
    pub macro_average: Option<f64>,
    /// Within each task.
    pub tasks: BTreeMap<String, Option<f64>>,
}

impl Metrics {
    /// Computes the metrics; `positive_share` is the share of positives that determined the class
    /// weights of the training.
    pub fn measure(samples: &ScoredSamples, positive_share: f64) -> Metrics {
        let probabilities: Vec<f32> =
            samples.logits.iter().map(|logit| probability(*logit)).collect();
        let reliability = reliability(&probabilities, &samples.labels, BINS);
        let phase = |phase| samples.discrimination(|index| samples.phase(index) == phase);
        Metrics {
            loss: weighted_loss(&samples.logits, &samples.labels, positive_share),
            auroc: samples.discrimination(|_| true),
            auroc_first_steps: phase(Phase::First),
            auroc_middle_steps: phase(Phase::Middle),
            auroc_last_steps: phase(Phase::Last),
            brier_score: brier_score(&probabilities, &samples.labels),
            calibration_error: calibration_error(&reliability),
            reliability,
        }
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Phase {
    First,
    Middle,
    Last,
}

impl ScoredSamples {
    fn phase(&self, index: usize) -> Phase {
        let step = self.steps[index];
        if step < PHASE_STEPS {
            Phase::First
        } else if step + PHASE_STEPS < self.episode_steps[index] {
            Phase::Middle
        } else {
            Phase::Last
        }
    }

    fn discrimination(&self, counts: impl Fn(usize) -> bool) -> Discrimination {
        let area = |task: Option<&str>| {
            let samples = (0..self.labels.len()).filter(|index| counts(*index));
            let samples =
                samples.filter(|index| task.is_none_or(|task| self.tasks[*index] == task));
            let (scores, labels): (Vec<f32>, Vec<bool>) =
                samples.map(|index| (self.logits[index], self.labels[index])).unzip();
            auroc(&scores, &labels)
        };
        let mut tasks: BTreeMap<String, Option<f64>> =
            self.tasks.iter().map(|task| (task.clone(), None)).collect();
        tasks.iter_mut().for_each(|(task, value)| *value = area(Some(task)));
        let values: Vec<f64> = tasks.values().copied().flatten().collect();
        let macro_average =
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
        Discrimination { pooled: area(None), macro_average, tasks }
    }
}

/// Equation 4 over scored samples in f64; the training loss computes the same with tensors. `None`
/// without samples.
///
/// D are all samples, D+ the positives and D- the negatives. The weights are w+ = |D| / 2|D+| and
/// w- = |D| / 2|D-|. The loss is the mean over D of w+ ln(1 + e^-z) for positives and w- ln(1 +
/// e^z) for negatives, where z is the logit. The mean must be over all of D so that both classes
/// contribute equally, which is the purpose of the weights in the paper.
pub fn weighted_loss(logits: &[f32], labels: &[bool], positive_share: f64) -> Option<f64> {
    assert_eq!(logits.len(), labels.len(), "one label per logit");
    let (positive, negative) = (0.5 / positive_share, 0.5 / (1.0 - positive_share));
    let losses = logits.iter().zip(labels).map(|(logit, label)| {
        let logit = f64::from(*logit);
        if *label { positive * softplus(-logit) } else { negative * softplus(logit) }
    });
    (!logits.is_empty()).then(|| losses.sum::<f64>() / logits.len() as f64)
}

/// ln(1 + e^x) without overflow.
fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples(rows: &[(f32, bool, &str, usize, usize)]) -> ScoredSamples {
        ScoredSamples {
            logits: rows.iter().map(|row| row.0).collect(),
            labels: rows.iter().map(|row| row.1).collect(),
            tasks: rows.iter().map(|row| row.2.to_owned()).collect(),
            steps: rows.iter().map(|row| row.3).collect(),
            episode_steps: rows.iter().map(|row| row.4).collect(),
        }
    }

    #[test]
    fn a_score_that_only_knows_the_task_looks_good_when_pooled() {
        // Task a succeeds in three of four samples, task b in one of four. The score separates the
        // tasks and nothing else.
        let rows: Vec<_> = (0..8)
            .map(|i| if i < 4 { (1.0, i != 0, "a", 0, 60) } else { (-1.0, i == 4, "b", 0, 60) })
            .collect();
        let auroc = Metrics::measure(&samples(&rows), 0.5).auroc;
        assert_eq!(auroc.pooled, Some(0.75));
        assert_eq!(auroc.macro_average, Some(0.5));
        assert_eq!(
            auroc.tasks,
            BTreeMap::from([("a".to_owned(), Some(0.5)), ("b".to_owned(), Some(0.5))])
        );
    }

    #[test]
    fn phases_are_the_first_ten_and_the_last_ten_steps() {
        let mut rows = Vec::new();
        for step in 0..30 {
            // The score is wrong in the first ten steps, uninformative in the middle and right in
            // the last ten.
            let strength = if step < 10 {
                -1.0
            } else if step < 20 {
                0.0
            } else {
                1.0
            };
            rows.push((strength, true, "a", step, 30));
            rows.push((-strength, false, "a", step, 30));
        }
        let metrics = Metrics::measure(&samples(&rows), 0.5);
        assert_eq!(metrics.auroc_first_steps.pooled, Some(0.0));
        assert_eq!(metrics.auroc_middle_steps.pooled, Some(0.5));
        assert_eq!(metrics.auroc_last_steps.pooled, Some(1.0));
        assert_eq!(metrics.auroc.pooled, Some(0.5));
    }

    #[test]
    fn a_task_with_one_class_has_no_value_and_is_not_in_the_average() {
        let rows = [(1.0, true, "a", 0, 60), (0.0, false, "a", 0, 60), (0.5, true, "b", 0, 60)];
        let metrics = Metrics::measure(&samples(&rows), 0.5);
        assert_eq!(metrics.auroc.tasks["b"], None);
        assert_eq!(metrics.auroc.macro_average, Some(1.0));
        let empty = Metrics::measure(&ScoredSamples::default(), 0.5);
        assert_eq!((empty.loss, empty.auroc.pooled, empty.calibration_error), (None, None, None));
    }

    #[test]
    fn the_loss_of_an_undecided_verifier_is_ln_2_for_any_classes() {
        let labels: Vec<bool> = (0..10).map(|i| i < 7).collect();
        let loss = weighted_loss(&[0.0; 10], &labels, 0.7).expect("samples");
        assert!((loss - 2.0_f64.ln()).abs() < 1e-12);
    }
}
