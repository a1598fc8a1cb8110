//! Verifiers of synthetic episodes: learning, held-out data, refusals.

use decision::{
    ActionChunk, ActionSpace, Candidate, Image, Parsed, Reasoning, ScoringRequest, TaskId,
    TrackedObjects,
};
use rand::Rng;

use super::*;
use crate::CandidateFeatures;

/// A decision between candidates with equal actions and different confidence; no object is tracked.
pub(super) fn decision(confidence: &[Vec<f32>]) -> DecisionSample {
    let candidates: Vec<Candidate> =
        confidence.iter().map(|confidence| candidate(&[], confidence)).collect();
    let space = ActionSpace { scale: vec![1.0; 7], gripper: Some(6) };
    DecisionSample {
        hidden_mean: vec![0.5, 0.25],
        statistics: [0.0; STATISTICS],
        candidates: CandidateFeatures::of(&candidates, &space).expect("whole"),
        gripper: Some([0.0; 2]),
        tracked: TrackedObjects::default(),
    }
}

fn candidate(hidden: &[f32], confidence: &[f32]) -> Candidate {
    Candidate {
        tokens: Vec::new(),
        log_probability: -1.0,
        log_probabilities: Vec::new(),
        confidence: confidence.to_vec(),
        hidden: hidden.to_vec(),
        parsed: Ok(Parsed {
            reasoning: Reasoning::default(),
            action_tokens: vec![500; 7],
            actions: ActionChunk::single(vec![0.0; 7]).expect("finite"),
        }),
    }
}

/// Episodes of two tasks. The second of four features predicts success, with noise; the others are
/// noise.
fn synthetic(episodes: usize, signal: f32, seed: u64) -> Vec<TrainingEpisode> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut episode = |number: usize| {
        let is_success = random.random_bool(0.6);
        let steps: Vec<usize> = (0..30).collect();
        let shift = if is_success { signal } else { -signal };
        let row = |random: &mut ChaCha8Rng| {
            let mut row: Vec<f32> =
                (0..4).map(|_| random.random_range(-1.0..1.0_f32) * 3.0 + 5.0).collect();
            row[1] += shift;
            row
        };
        let task = if number.is_multiple_of(2) { "even" } else { "odd" };
        TrainingEpisode {
            name: format!("episode {number}"),
            start: LayoutKey { task: TaskId::default_of(task), layout: None, seed: number as u64 },
            instruction: String::new(),
            is_success,
            hidden: steps.iter().flat_map(|_| row(&mut random)).collect(),
            steps,
            steps_total: 30,
            steps_max: 30,
            decisions: None,
        }
    };
    (0..episodes).map(&mut episode).collect()
}

fn options() -> TrainingOptions {
    TrainingOptions {
        hidden_sizes: [16, 8],
        epochs_max: 12,
        batch_samples: 64,
        learning_rate: 3e-3,
        validation_share: 0.2,
        ..TrainingOptions::default()
    }
}

fn trained(episodes: Vec<TrainingEpisode>, options: &TrainingOptions) -> Verifier {
    let set = TrainingSet::new(4, 7, episodes).expect("a whole set");
    train(&set, "cafe", options, |_| ()).expect("a verifier")
}

#[test]
fn a_signal_in_the_hidden_state_is_learned() {
    let verifier = trained(synthetic(60, 2.0, 1), &options());
    let VerifierDescription { data, held_out, .. } = verifier.description();
    let TrainingData { training_episodes, validation_episodes, held_out_episodes, .. } = data;
    assert_eq!(training_episodes + validation_episodes + held_out_episodes, 60);
    assert_eq!(data.held_out_samples, held_out_episodes * 30);
    assert!(held_out.auroc.macro_average.expect("both classes") > 0.85, "{held_out:?}");
    assert!(held_out.loss.expect("samples") < 0.5, "{held_out:?}");
    assert_eq!(held_out.auroc.tasks.len(), 2);
    // The sign is correct: a larger second feature is better.
    let candidates = [[5.0, 9.0, 5.0, 5.0], [5.0, 1.0, 5.0, 5.0]];
    let candidates = candidates.map(|hidden| candidate(&hidden, &[]));
    let logits = verifier.logits(&ScoringRequest {
        image: &Image::default(),
        state: &[],
        instruction: "",
        candidates: &candidates,
        tracked: TrackedObjects::default(),
        action_space: &ActionSpace { scale: vec![1.0; 7], gripper: None },
    });
    let logits = logits.expect("scores");
    assert!(logits[0] > 1.0 && logits[1] < -1.0, "{logits:?}");
}

#[test]
fn nothing_is_learned_without_a_signal() {
    let verifier = trained(synthetic(60, 0.0, 2), &options());
    let auroc = verifier.description().held_out.auroc.pooled.expect("both classes");
    assert!((auroc - 0.5).abs() < 0.1, "{auroc}");
}

#[test]
fn same_episodes_same_bytes_in_any_order_and_run() {
    let episodes = synthetic(30, 1.0, 3);
    let mut shuffled = episodes.clone();
    shuffled.reverse();
    // A run's name contains random digits.
    for (index, episode) in shuffled.iter_mut().enumerate() {
        episode.name = format!("again {index}");
    }
    let options = TrainingOptions { epochs_max: 2, ..options() };
    let first = trained(episodes.clone(), &options);
    assert_eq!(first.digest(), trained(shuffled, &options).digest());
    let other = TrainingOptions { seed: 1, ..options };
    assert_ne!(first.digest(), trained(episodes, &other).digest());
}

#[test]
fn training_stops_at_the_lowest_validation_loss() {
    let set = TrainingSet::new(4, 7, synthetic(40, 0.5, 4)).expect("a whole set");
    let options = TrainingOptions { epochs_max: 60, patience_epochs: 3, ..options() };
    let mut epochs = Vec::new();
    let verifier = train(&set, "cafe", &options, |epoch| epochs.push(epoch)).expect("a verifier");
    let best = epochs.iter().rev().find(|epoch| epoch.is_best).expect("one is best");
    assert_eq!(verifier.description().data.epochs, best.epoch);
    assert_eq!(epochs.len(), best.epoch + 3, "three epochs without a lower loss end the training");
    assert!(epochs.iter().all(|epoch| epoch.validation_loss >= best.validation_loss));
}

#[test]
fn held_out_episodes_change_only_the_metrics() {
    let mut episodes = synthetic(60, 1.0, 6);
    for (number, episode) in episodes.iter_mut().enumerate() {
        let confidence = |step: usize| vec![((number * 7 + step * 3) % 11) as f32 * -0.2; 16];
        let mut decision = |step: usize| {
            let mut decision = decision(&[confidence(step), confidence(step + 1)]);
            decision.hidden_mean = vec![number as f32 * 0.01; 4];
            decision
        };
        episode.decisions = Some((0..30).map(&mut decision).collect());
    }
    let options = TrainingOptions { epochs_max: 3, ..options() };
    let set = TrainingSet::new(4, 7, episodes).expect("a whole set");
    let split = set.split(options.validation_share, options.held_out_share, options.seed);
    let mut changed = set.episodes().to_vec();
    for index in &split.held_out {
        changed[*index].hidden.iter_mut().for_each(|value| *value = -*value);
        for decision in changed[*index].decisions.iter_mut().flatten() {
            decision.statistics = [1.0; STATISTICS];
            decision.hidden_mean = vec![9.0; 4];
        }
    }
    let parts = |episodes: Vec<TrainingEpisode>| {
        let verifier = trained(episodes, &options);
        let description = verifier.description().clone();
        let bytes = verifier.bytes();
        let header = u64::from_le_bytes(bytes[..8].try_into().expect("a length")) as usize;
        (bytes[8 + header..].to_vec(), description)
    };
    let (first, second) = (parts(set.episodes().to_vec()), parts(changed));
    assert!(first.1.ranking.is_some());
    assert!(first.0 == second.0, "the same weights");
    assert_eq!(first.1.ranking, second.1.ranking);
    assert_ne!(first.1.held_out, second.1.held_out);
}

#[test]
fn outcomes_of_a_single_class_are_refused() {
    let mut episodes = synthetic(10, 1.0, 5);
    episodes.iter_mut().for_each(|episode| episode.is_success = true);
    let set = TrainingSet::new(4, 7, episodes).expect("a whole set");
    let error = train(&set, "cafe", &options(), |_| ()).err().expect("no failures");
    assert_eq!(
        error.to_string(),
        "training episodes: expected successes and failures, got 6 successes in 6 episodes; collect more episodes"
    );
}

#[test]
fn invalid_options_are_refused() {
    let set = TrainingSet::new(4, 7, synthetic(10, 1.0, 5)).expect("a whole set");
    let refuse = |options: TrainingOptions| {
        train(&set, "cafe", &options, |_| ()).err().expect("refused").to_string()
    };
    assert_eq!(
        refuse(TrainingOptions { held_out_share: 1.0, ..options() }),
        "held-out share: expected between 0 and 1, got 1"
    );
    assert_eq!(
        refuse(TrainingOptions { validation_share: 0.75, held_out_share: 0.25, ..options() }),
        "validation and held-out share: expected a sum below 1, got 1"
    );
    assert_eq!(
        refuse(TrainingOptions { epochs_max: 0, ..options() }),
        "epochs: expected 1 to 10000, got 0"
    );
    assert_eq!(
        refuse(TrainingOptions { batch_samples: 0, ..options() }),
        "batch: expected at least 1 sample, got 0"
    );
}
