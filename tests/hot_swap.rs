//! A verifier that is published during a run is used from the next episode on, never within an
//! episode.

use std::path::Path;

use decision::TaskId;
use runtime::wire::{Network, NetworkOptions, VerifierPublisher};
use store::record::EpisodeRecord;
use verifier::training::{LayoutKey, TrainingEpisode, TrainingSet, train};
use verifier::{TrainingOptions, Verifier};
use vla::{CompletionParser, LoadOptions};

use crate::evaluation::{Evaluation, WAIT};
use crate::harness::{repository, wait_for};
use crate::server::free_endpoint;

const EPISODES: usize = 6;
/// Digest of the shipped policy.
const HIDDEN_SIZE: usize = 256;
const ACTION_LENGTH: usize = 7;

#[tokio::test(flavor = "multi_thread")]
async fn a_published_verifier_is_used_from_the_next_episode_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let model = repository().join("agent/models/bridge-small");
    let policy = CompletionParser::load(&model, &LoadOptions::default()).expect("a policy");
    let (first, second) = (verifier(policy.digest(), 1), verifier(policy.digest(), 2));
    let path = folder.path().join("first.safetensors");
    std::fs::write(&path, first.bytes()).expect("the first verifier is written");

    let endpoint = free_endpoint();
    let named = format!("--verifier={}", path.display());
    let evaluation = evaluation(folder.path(), &endpoint, &[&named]);
    let mut running = evaluation.start();
    evaluation.wait_for_records(&mut running, 1);
    let options = NetworkOptions { connect: vec![endpoint], ..NetworkOptions::default() };
    let network = Network::open(options).await.expect("the agent is reached");
    let publisher = VerifierPublisher::declare(&network, "live").await.expect("a publisher");
    publisher.publish(policy.digest(), second.bytes().to_vec()).await.expect("it is published");
    assert!(running.succeeds(), "{}", evaluation.words());

    // With one session, episodes are numbered in the order in which they run.
    let used: Vec<_> =
        evaluation.records().into_values().filter_map(|record| record.versions.verifier).collect();
    let change = used.iter().position(|digest| digest == second.digest());
    let change = change.unwrap_or_else(|| panic!("never taken up: {}", evaluation.words()));
    assert!(change > 0, "the first episode was recorded before the second verifier was there");
    assert_eq!(used.len(), EPISODES);
    assert!(used[..change].iter().all(|digest| digest == first.digest()));
    assert!(used[change..].iter().all(|digest| digest == second.digest()));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_verifier_of_another_policy_is_not_used() {
    let folder = tempfile::tempdir().expect("a folder");
    let model = repository().join("agent/models/bridge-small");
    let policy = CompletionParser::load(&model, &LoadOptions::default()).expect("a policy");
    let (foreign, fitting) = (verifier(&"0".repeat(64), 1), verifier(policy.digest(), 2));
    let endpoint = free_endpoint();
    let evaluation = evaluation(folder.path(), &endpoint, &[]);
    let running = evaluation.start();
    let has_said = |words: &str| evaluation.words().contains(words).then_some(());
    wait_for("the agent", WAIT, || has_said("waiting for versions of verifier live"));
    let options = NetworkOptions { connect: vec![endpoint], ..NetworkOptions::default() };
    let network = Network::open(options).await.expect("the agent is reached");
    let publisher = VerifierPublisher::declare(&network, "live").await.expect("a publisher");
    let other = "0".repeat(64);
    publisher.publish(&other, foreign.bytes().to_vec()).await.expect("it is published");
    wait_for("a refusal", WAIT, || has_said("is ignored"));
    publisher.publish(policy.digest(), fitting.bytes().to_vec()).await.expect("it is published");
    assert!(running.succeeds(), "{}", evaluation.words());
    let records = evaluation.records();
    assert_eq!(records.len(), EPISODES);
    let used =
        |record: &EpisodeRecord| record.versions.verifier.as_deref() == Some(fitting.digest());
    assert!(records.values().all(used));
}

fn evaluation(folder: &Path, endpoint: &str, more: &[&str]) -> Evaluation {
    let arguments = [
        "--tasks=widowx_spoon_on_towel",
        "--strategies=verifier",
        "--candidates=2",
        &format!("--episodes={EPISODES}"),
        "--sessions=1",
        "--servers=1",
        "--follow-verifier=live",
        &format!("--listen={endpoint}"),
    ];
    Evaluation::new(folder, &[&arguments, more].concat())
}

/// A verifier fitted to random numbers: only its identity matters here, not its scores.
fn verifier(policy: &str, seed: u64) -> Verifier {
    let size = HIDDEN_SIZE;
    let episodes = (0..20).map(|number| {
        let value = |index: usize| ((index * 7919 + number * 104_729) % 1000) as f32 / 1000.0;
        TrainingEpisode {
            name: format!("episode {number}"),
            start: LayoutKey {
                task: TaskId::default_of("widowx_spoon_on_towel"),
                layout: None,
                seed: number as u64,
            },
            instruction: String::new(),
            is_success: number % 2 == 0,
            hidden: (0..size).map(value).collect(),
            steps: vec![0],
            steps_total: 1,
            steps_max: 60,
            decisions: None,
        }
    });
    let set = TrainingSet::new(size, ACTION_LENGTH, episodes).expect("a training set");
    let options = TrainingOptions { seed, epochs_max: 1, ..TrainingOptions::default() };
    train(&set, policy, &options, |_| ()).expect("it can be trained")
}
