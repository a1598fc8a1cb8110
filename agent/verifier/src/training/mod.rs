//! Trains a verifier on finished episodes: the steps of a success are positives, the steps of a
//! failure negatives.
//!
//! ```text
//! records ─▶ eligible episodes ─▶ split by initial layout ─┬▶ training: network, by equation 4
//!                                                          ├▶ validation: when training stops
//!                                                          └▶ held out: metrics only
//! grasps, releases of successes ─▶ target model: where the gripper should go ┐
//! sampled candidates ─▶ critic ─▶ advantages ────────────────────────────────┴▶ ranking: which candidate is better
//! ```
//!
//! The same episodes, options and seed give the same file.

// Training data.
pub(crate) mod decision_sample;
mod eligibility;
pub mod records;
mod set;
mod split;

// Models.
mod advantage;
mod learner;
mod least_squares;
mod ranking;
mod target;

use anyhow::{Context, ensure};
use candle_nn::optim::{AdamW, Optimizer, ParamsAdamW};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

pub use decision_sample::{DecisionSample, STATISTICS};
pub use eligibility::{ExclusionReason, exclude_label, exclude_record};
pub use ranking::EPISODES_MIN;
pub use set::{LayoutKey, TrainingEpisode, TrainingSet};
pub use split::Split;

use crate::{
    Metrics, Network, ScoredSamples, Standardisation, TrainingData, TrainingOptions, Verifier,
    VerifierDescription, weighted_loss,
};
use learner::{Learner, Samples};

/// One pass over the training samples.
#[derive(Clone, Copy, Debug)]
pub struct Epoch {
    /// Number of the epoch, from 1.
    pub epoch: usize,
    /// Mean loss of the pass, in nats.
    pub training_loss: f64,
    /// Loss on the validation episodes after the pass, in nats.
    pub validation_loss: f64,
    /// Whether no earlier pass had a lower validation loss.
    pub is_best: bool,
}

/// Trains until the validation loss stops falling, keeps the weights with the lowest validation
/// loss and measures them on the held-out episodes.
///
/// The same set, policy and options give the same file, independent of the order of the episodes.
pub fn train(
    set: &TrainingSet,
    policy: &str,
    options: &TrainingOptions,
    progress: impl FnMut(Epoch),
) -> anyhow::Result<Verifier> {
    options.check()?;
    let split = set.split(options.validation_share, options.held_out_share, options.seed);
    let data = data(set, &split)?;
    let labels = set.labels(&split.training);
    let positives = labels.iter().filter(|label| **label).count();
    let positive_share = positives as f64 / labels.len() as f64;
    let (epochs, network) = fit(set, &split, options, positive_share, progress)?;
    let held_out = Metrics::measure(&score(set, &split.held_out, &network), positive_share);
    let ranking = if options.ranking {
        let episodes = [split.training, split.validation].concat();
        ranking::fit(set, &episodes, options)?
    } else {
        None
    };
    let (ranking, evidence) = ranking.unzip();
    let description = VerifierDescription {
        policy: policy.to_owned(),
        input_size: set.input_size(),
        action_length: set.action_length(),
        options: options.clone(),
        data: TrainingData { epochs, ..data },
        held_out,
        ranking: evidence,
    };
    Verifier::new(&network, ranking.as_ref(), &description)
}

/// Fits the network to the training episodes; also returns the epoch with the lowest validation
/// loss.
fn fit(
    set: &TrainingSet,
    split: &Split,
    options: &TrainingOptions,
    positive_share: f64,
    mut progress: impl FnMut(Epoch),
) -> anyhow::Result<(usize, Network)> {
    let hidden = || set.hidden(&split.training);
    let standardisation = Standardisation::of(set.input_size(), hidden());
    let labels = set.labels(&split.training);
    let samples = Samples::new(&standardisation, hidden(), &labels, positive_share)?;
    let mut random = ChaCha8Rng::seed_from_u64(options.seed);
    let learner = Learner::new(set.input_size(), options.hidden_sizes, &mut random)?;
    let parameters = ParamsAdamW {
        lr: options.learning_rate,
        weight_decay: options.weight_decay,
        ..ParamsAdamW::default()
    };
    let mut optimizer = AdamW::new(learner.variables(), parameters)?;
    let mut best: Option<(usize, f64, Network)> = None;
    for epoch in 1..=options.epochs_max {
        let mut order: Vec<u32> = (0..labels.len() as u32).collect();
        order.shuffle(&mut random);
        let training_loss =
            pass(&learner, &mut optimizer, &samples, &order, options.batch_samples)?;
        let network = learner.network(&standardisation)?;
        let validation = score(set, &split.validation, &network);
        let validation_loss = weighted_loss(&validation.logits, &validation.labels, positive_share);
        let validation_loss = validation_loss
            .context("validation episodes: expected at least one sample, got none")?;
        ensure!(
            validation_loss.is_finite(),
            "epoch {epoch}: expected a finite validation loss, got {validation_loss}"
        );
        let is_best = best.as_ref().is_none_or(|(_, loss, _)| validation_loss < *loss);
        progress(Epoch { epoch, training_loss, validation_loss, is_best });
        let passes_since_best = best.as_ref().map_or(0, |(best_epoch, ..)| epoch - best_epoch);
        if is_best {
            best = Some((epoch, validation_loss, network));
        } else if passes_since_best >= options.patience_epochs {
            break;
        }
    }
    let (epochs, _, network) = best.context("no epoch was run")?;
    Ok((epochs, network))
}

/// Counts episodes and samples of the split. Each part needs successes and failures.
fn data(set: &TrainingSet, split: &Split) -> anyhow::Result<TrainingData> {
    let count = |name: &str, side: &[usize]| {
        let episodes = side.len();
        let successes = side.iter().filter(|index| set.episodes()[**index].is_success).count();
        ensure!(
            successes > 0 && successes < episodes,
            "{name} episodes: expected successes and failures, got {successes} successes in {episodes} episodes; collect more episodes"
        );
        Ok((episodes, successes, set.labels(side).len()))
    };
    let (training_episodes, training_successes, training_samples) =
        count("training", &split.training)?;
    let (validation_episodes, validation_successes, validation_samples) =
        count("validation", &split.validation)?;
    let (held_out_episodes, held_out_successes, held_out_samples) =
        count("held-out", &split.held_out)?;
    Ok(TrainingData {
        training_episodes,
        training_successes,
        training_samples,
        validation_episodes,
        validation_successes,
        validation_samples,
        held_out_episodes,
        held_out_successes,
        held_out_samples,
        epochs: 0,
    })
}

/// One pass over the samples in the given order; returns the mean loss.
fn pass(
    learner: &Learner,
    optimizer: &mut AdamW,
    samples: &Samples,
    order: &[u32],
    batch_samples: usize,
) -> anyhow::Result<f64> {
    let mut sum = 0.0;
    for batch in order.chunks(batch_samples) {
        let loss = learner.loss(samples, batch)?;
        optimizer.backward_step(&loss)?;
        sum += f64::from(loss.to_scalar::<f32>()?) * batch.len() as f64;
    }
    Ok(sum / order.len() as f64)
}

/// Scores the executed candidates of episodes with the network, not with the training tensors. The
/// ranking compares candidates of one decision, of which only one was executed, so it is not part
/// of these metrics.
fn score(set: &TrainingSet, episodes: &[usize], network: &Network) -> ScoredSamples {
    let mut samples = ScoredSamples::default();
    for episode in episodes.iter().map(|episode| &set.episodes()[*episode]) {
        let rows = episode.hidden.chunks_exact(set.input_size());
        for (row, step) in rows.zip(&episode.steps) {
            samples.logits.push(network.logit(row));
            samples.labels.push(episode.is_success);
            samples.tasks.push(episode.start.task.to_string());
            samples.steps.push(*step);
            samples.episode_steps.push(episode.steps_total);
        }
    }
    samples
}

#[cfg(test)]
mod tests;
