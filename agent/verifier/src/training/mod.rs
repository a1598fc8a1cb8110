//! Trains a verifier on finished episodes: every step of a success is a positive, every step of a failure a negative.
//!
//! ```text
//! hidden states, outcomes ─▶ network, by equation 4: how promising a situation is
//! grasps, places of successes ─▶ aim: where the gripper should go, by what was said
//! siblings of drawn candidates ─▶ critic ─▶ advantages ─▶ choice: which candidate is better
//! ```

mod advantage;
mod aim;
mod choice;
mod decision;
mod learner;
mod objection;
pub mod records;
mod set;

use anyhow::{Context, ensure};
use candle_nn::optim::{AdamW, Optimizer, ParamsAdamW};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;

pub use decision::{DecisionSample, STATISTICS};
pub use set::{LabelledEpisode, Split, TrainingSet};

use crate::verifier::{Description, Evidence, HeldOut, Metrics, Network, Options, Standardisation, Verifier, weighted_loss};
use learner::{Learner, Samples};

/// What one pass over the training samples came to.
#[derive(Clone, Copy, Debug)]
pub struct Epoch {
    /// Counted from 1.
    pub epoch: usize,
    /// Mean loss of the pass, in nats.
    pub training_loss: f64,
    /// Loss on the held-out episodes after the pass, in nats.
    pub held_out_loss: f64,
    /// Whether no earlier pass had a lower held-out loss.
    pub is_best: bool,
}

/// Trains until the held-out loss stops falling and keeps the weights of its lowest point.
///
/// The same set, policy and options give the same file, whatever the order in which the episodes came.
pub fn train(
    set: &TrainingSet,
    policy: &str,
    options: &Options,
    mut progress: impl FnMut(Epoch),
) -> anyhow::Result<Verifier> {
    check(options)?;
    let split = set.split(options.held_out_share, options.seed);
    let evidence = evidence(set, &split)?;
    let positive_share = set.positive_share(&split.training);
    let hidden = || {
        split
            .training
            .iter()
            .flat_map(|episode| set.episodes()[*episode].hidden.chunks_exact(set.input_size()))
    };
    let standardisation = Standardisation::of(set.input_size(), hidden());
    let labels = set.labels(&split.training);
    let samples = Samples::new(&standardisation, hidden(), &labels, positive_share)?;

    let mut random = StdRng::seed_from_u64(options.seed);
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
        let held_out = score(set, &split.held_out, &network);
        let held_out_loss = weighted_loss(&held_out.logits, &held_out.labels, positive_share);
        let held_out_loss = held_out_loss.context("held-out episodes without samples")?;
        ensure!(
            held_out_loss.is_finite(),
            "epoch {epoch}: expected a finite held-out loss, got {held_out_loss}"
        );
        let is_best = best.as_ref().is_none_or(|(_, loss, _)| held_out_loss < *loss);
        progress(Epoch { epoch, training_loss, held_out_loss, is_best });
        if is_best {
            best = Some((epoch, held_out_loss, network));
        } else if best
            .as_ref()
            .is_some_and(|(best_epoch, ..)| epoch - best_epoch >= options.patience_epochs)
        {
            break;
        }
    }
    let (epochs, _, network) = best.context("no epoch was run")?;
    let held_out = Metrics::measure(&score(set, &split.held_out, &network), positive_share);
    let choice = if options.choice { choice::fit(set, options)? } else { None };
    let (choice, choice_evidence) = choice.unzip();
    let description = Description {
        policy: policy.to_owned(),
        input_size: set.input_size(),
        options: options.clone(),
        evidence: Evidence { epochs, ..evidence },
        held_out,
        choice: choice_evidence,
    };
    Verifier::new(&network, choice.as_ref(), &description)
}

fn check(options: &Options) -> anyhow::Result<()> {
    let Options { hidden_sizes, epochs_max, batch_samples, learning_rate, .. } = options;
    let Options { held_out_share, advantage_decay, choice_ridge, aim_factor, .. } = options;
    ensure!(
        hidden_sizes.iter().all(|size| (1..=4096).contains(size)),
        "hidden sizes: expected 1 to 4096, got {hidden_sizes:?}"
    );
    ensure!((1..=10_000).contains(epochs_max), "epochs: expected 1 to 10000, got {epochs_max}");
    ensure!(*batch_samples > 0, "batch: expected at least 1 sample, got 0");
    ensure!(
        learning_rate.is_finite() && *learning_rate > 0.0,
        "learning rate: expected more than 0, got {learning_rate}"
    );
    ensure!(
        *held_out_share > 0.0 && *held_out_share < 1.0,
        "held-out share: expected between 0 and 1, got {held_out_share}"
    );
    ensure!(
        (0.0..=1.0).contains(advantage_decay),
        "advantage decay: expected 0 to 1, got {advantage_decay}"
    );
    ensure!(
        choice_ridge.is_finite() && *choice_ridge > 0.0,
        "choice ridge: expected more than 0, got {choice_ridge}"
    );
    ensure!(
        aim_factor.is_finite() && *aim_factor >= 0.0,
        "aim factor: expected 0 or more, got {aim_factor}"
    );
    Ok(())
}

/// Counts both sides of the split; both need successes and failures, or there is nothing to tell apart.
fn evidence(set: &TrainingSet, split: &Split) -> anyhow::Result<Evidence> {
    let successes =
        |side: &[usize]| side.iter().filter(|episode| set.episodes()[**episode].is_success).count();
    let evidence = Evidence {
        training_episodes: split.training.len(),
        training_successes: successes(&split.training),
        training_samples: set.labels(&split.training).len(),
        held_out_episodes: split.held_out.len(),
        held_out_successes: successes(&split.held_out),
        held_out_samples: set.labels(&split.held_out).len(),
        epochs: 0,
    };
    let sides = [
        ("training", evidence.training_episodes, evidence.training_successes),
        ("held out", evidence.held_out_episodes, evidence.held_out_successes),
    ];
    for (side, episodes, successes) in sides {
        ensure!(
            successes > 0 && successes < episodes,
            "{side} episodes: expected successes and failures, got {successes} successes of {episodes}"
        );
    }
    Ok(evidence)
}

/// One pass over the samples in the given order; the mean loss.
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

/// Scores the executed candidates of held-out episodes with the network's plain loops, not with the tensors that were
/// trained. The choice part tells siblings apart, of which only one was executed, so that it has no place in these figures.
fn score(set: &TrainingSet, episodes: &[usize], network: &Network) -> HeldOut {
    let mut held_out = HeldOut::default();
    for episode in episodes.iter().map(|episode| &set.episodes()[*episode]) {
        let rows = episode.hidden.chunks_exact(set.input_size());
        for (row, step) in rows.zip(&episode.steps) {
            held_out.logits.push(network.logit(row));
            held_out.labels.push(episode.is_success);
            held_out.tasks.push(episode.task.clone());
            held_out.steps.push(*step);
            held_out.episode_steps.push(episode.steps_total);
        }
    }
    held_out
}

#[cfg(test)]
mod tests {
    use super::*;
    use decision::TrackedObjects;
    use crate::verifier::Siblings;
    use rand::Rng;

    /// Episodes of two tasks whose success shows, noisily, in the second of four features; the rest is noise.
    fn synthetic(episodes: usize, signal: f32, seed: u64) -> Vec<LabelledEpisode> {
        let mut random = StdRng::seed_from_u64(seed);
        let mut episode = |number: usize| {
            let is_success = random.random_bool(0.6);
            let steps: Vec<usize> = (0..30).collect();
            let shift = if is_success { signal } else { -signal };
            let row = |random: &mut StdRng| {
                let mut row: Vec<f32> =
                    (0..4).map(|_| random.random_range(-1.0..1.0_f32) * 3.0 + 5.0).collect();
                row[1] += shift;
                row
            };
            let hidden = steps.iter().flat_map(|_| row(&mut random)).collect();
            let task = if number.is_multiple_of(2) { "even" } else { "odd" }.to_owned();
            LabelledEpisode {
                name: format!("episode {number}"),
                task,
                instruction: String::new(),
                is_success,
                hidden,
                steps,
                steps_total: 30,
                decisions: None,
            }
        };
        (0..episodes).map(&mut episode).collect()
    }

    fn options() -> Options {
        Options {
            hidden_sizes: [16, 8],
            epochs_max: 12,
            batch_samples: 64,
            learning_rate: 3e-3,
            ..Options::default()
        }
    }

    fn trained(episodes: Vec<LabelledEpisode>, options: &Options) -> Verifier {
        let set = TrainingSet::new(4, episodes).expect("a whole set");
        train(&set, "cafe", options, |_| ()).expect("a verifier")
    }

    #[test]
    fn what_shows_in_the_hidden_state_is_learnt() {
        let verifier = trained(synthetic(60, 2.0, 1), &options());
        let Description { evidence, held_out, .. } = verifier.description();
        assert_eq!(evidence.training_episodes + evidence.held_out_episodes, 60);
        assert_eq!(evidence.held_out_samples, evidence.held_out_episodes * 30);
        assert!(held_out.auroc.macro_average.expect("both classes") > 0.85, "{held_out:?}");
        assert!(held_out.loss.expect("samples") < 0.5, "{held_out:?}");
        assert_eq!(held_out.auroc.tasks.len(), 2);
        // And the sign is right: more of the second feature is better.
        let logits = verifier.logits(&Siblings {
            hidden: &[&[5.0, 9.0, 5.0, 5.0], &[5.0, 1.0, 5.0, 5.0]],
            candidates: &[None, None],
            action_scale: &[1.0; 7],
            instruction: "",
            gripper: [0.0; 2],
            tracked: TrackedObjects::default(),
        });
        assert!(logits[0] > 1.0 && logits[1] < -1.0, "{logits:?}");
    }

    #[test]
    fn nothing_is_found_where_nothing_is() {
        let verifier = trained(synthetic(60, 0.0, 2), &options());
        let auroc = verifier.description().held_out.auroc.pooled.expect("both classes");
        assert!((auroc - 0.5).abs() < 0.1, "{auroc}");
    }

    #[test]
    fn same_episodes_same_bytes_in_any_order() {
        let episodes = synthetic(30, 1.0, 3);
        let mut shuffled = episodes.clone();
        shuffled.reverse();
        let options = Options { epochs_max: 2, ..options() };
        let first = trained(episodes.clone(), &options);
        assert_eq!(first.digest(), trained(shuffled, &options).digest());
        assert_ne!(first.digest(), trained(episodes, &Options { seed: 1, ..options }).digest());
    }

    #[test]
    fn training_stops_at_the_lowest_held_out_loss() {
        let set = TrainingSet::new(4, synthetic(40, 0.5, 4)).expect("a whole set");
        let options = Options { epochs_max: 60, patience_epochs: 3, ..options() };
        let mut epochs = Vec::new();
        let verifier =
            train(&set, "cafe", &options, |epoch| epochs.push(epoch)).expect("a verifier");
        let best = epochs.iter().rev().find(|epoch| epoch.is_best).expect("one is best");
        assert_eq!(verifier.description().evidence.epochs, best.epoch);
        let loss = verifier.description().held_out.loss.expect("samples");
        assert!((loss - best.held_out_loss).abs() < 1e-12);
        assert_eq!(
            epochs.len(),
            best.epoch + 3,
            "three epochs without a lower loss end the training"
        );
        assert!(epochs.iter().all(|epoch| epoch.held_out_loss >= best.held_out_loss));
    }

    #[test]
    fn one_sided_outcomes_are_refused() {
        let mut episodes = synthetic(10, 1.0, 5);
        episodes.iter_mut().for_each(|episode| episode.is_success = true);
        let set = TrainingSet::new(4, episodes).expect("a whole set");
        let error = train(&set, "cafe", &options(), |_| ()).err().expect("no failures");
        assert_eq!(
            error.to_string(),
            "training episodes: expected successes and failures, got 8 successes of 8"
        );
    }

    #[test]
    fn senseless_options_are_refused() {
        let set = TrainingSet::new(4, synthetic(10, 1.0, 5)).expect("a whole set");
        let refuse = |options: Options| {
            train(&set, "cafe", &options, |_| ()).err().expect("refused").to_string()
        };
        assert_eq!(
            refuse(Options { held_out_share: 1.0, ..options() }),
            "held-out share: expected between 0 and 1, got 1"
        );
        assert_eq!(
            refuse(Options { epochs_max: 0, ..options() }),
            "epochs: expected 1 to 10000, got 0"
        );
        assert_eq!(
            refuse(Options { batch_samples: 0, ..options() }),
            "batch: expected at least 1 sample, got 0"
        );
    }
}
