//! A verifier published while a run goes on is taken up between two episodes, never inside one.

use std::path::Path;

use agent::policy::{DeviceName, Policy};
use agent::training::{LabelledEpisode, TrainingSet, train};
use agent::verifier::{Options, Verifier};
use agent::wire::{Network, NetworkOptions, VerifierPublisher};

use crate::evaluation::Evaluation;
use crate::harness::repository;
use crate::server::free_endpoint;

const EPISODES: usize = 6;

#[tokio::test(flavor = "multi_thread")]
async fn a_published_verifier_is_taken_up_between_episodes() {
    let folder = tempfile::tempdir().expect("a folder");
    let model = repository().join("agent/models/bridge-small");
    let policy = Policy::load(&model, DeviceName::Cpu).expect("a policy");
    let (first, second) = (verifier(&policy, 1), verifier(&policy, 2));
    let path = folder.path().join("first.safetensors");
    std::fs::write(&path, first.bytes()).expect("the first verifier is written");

    let endpoint = free_endpoint();
    let evaluation = evaluation(folder.path(), &endpoint, &path);
    let mut running = evaluation.start();
    evaluation.wait_for_records(&mut running, 1);
    let options = NetworkOptions { connect: vec![endpoint], ..NetworkOptions::default() };
    let network = Network::open(options).await.expect("the agent is reached");
    let publisher = VerifierPublisher::declare(&network, "live").await.expect("a publisher");
    publisher.publish(policy.digest(), second.bytes().to_vec()).await.expect("it is published");
    assert!(running.succeeds(), "{}", evaluation.words());

    // One session at a time: episodes are numbered in the order in which they ran.
    let used: Vec<_> =
        evaluation.records().into_values().filter_map(|record| record.versions.verifier).collect();
    let change = used.iter().position(|digest| digest == second.digest());
    let change = change.unwrap_or_else(|| panic!("never taken up: {}", evaluation.words()));
    assert!(change > 0, "the first episode was recorded before the second verifier was there");
    assert_eq!(used.len(), EPISODES);
    assert!(used[..change].iter().all(|digest| digest == first.digest()));
    assert!(used[change..].iter().all(|digest| digest == second.digest()));
}

fn evaluation(folder: &Path, endpoint: &str, verifier: &Path) -> Evaluation {
    let arguments = [
        "--tasks=widowx_spoon_on_towel",
        "--strategies=verifier",
        "--candidates=2",
        &format!("--episodes={EPISODES}"),
        "--sessions=1",
        "--servers=1",
        "--follow-verifier=live",
        &format!("--listen={endpoint}"),
        &format!("--verifier={}", verifier.display()),
    ];
    Evaluation::new(folder, &arguments)
}

/// Fitted to random numbers: what it says does not matter here, only which one it is.
fn verifier(policy: &Policy, seed: u64) -> Verifier {
    let size = policy.hidden_size();
    let episodes = (0..20).map(|number| {
        let value = |index: usize| ((index * 7919 + number * 104_729) % 1000) as f32 / 1000.0;
        LabelledEpisode {
            name: format!("episode {number}"),
            instruction: String::new(),
            task: "widowx_spoon_on_towel".to_owned(),
            is_success: number % 2 == 0,
            hidden: (0..size).map(value).collect(),
            steps: vec![0],
            steps_total: 1,
            decisions: None,
        }
    });
    let set = TrainingSet::new(size, episodes).expect("a training set");
    let options = Options { seed, epochs_max: 1, ..Options::default() };
    train(&set, policy.digest(), &options, |_| ()).expect("it can be trained")
}
