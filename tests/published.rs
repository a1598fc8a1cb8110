//! Published messages: outcomes for observers, verifiers for subscribers.

use std::time::Duration;

use protocol::{EpisodeOutcome, Statistics, decode};
use runtime::wire::{
    Network, NetworkOptions, OutcomePublisher, VerifierPublisher, VerifierSubscriber,
};

/// Maximum wait for an event that is nearly immediate on an idle machine.
const WAIT: Duration = Duration::from_secs(60);

async fn listen(fleet: &str) -> Network {
    let options = NetworkOptions { fleet: fleet.into(), ..NetworkOptions::default() };
    Network::open(options).await.expect("the network opens")
}

#[tokio::test(flavor = "multi_thread")]
async fn an_outcome_reaches_an_observer_but_does_not_wait_for_one() {
    let source = listen("outcomes").await;
    let publisher = OutcomePublisher::declare(&source, "run-1").await.expect("a publisher");
    publisher.publish(&outcome("run-1", 0)).expect("without any observer");
    let endpoints = format!("[\"{}\"]", source.listening()[0]);
    let mut configuration = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"client\""),
        ("connect/endpoints", &endpoints),
        ("scouting/multicast/enabled", "false"),
    ] {
        configuration.insert_json5(key, value).expect("zenoh has this option");
    }
    let observer = zenoh::open(configuration).await.expect("the observer connects");
    let outcomes =
        observer.declare_subscriber("rever/3/outcomes/outcome/*").await.expect("a subscriber");
    // The subscription must reach the publisher; earlier outcomes are lost.
    let seen = async {
        loop {
            publisher.publish(&outcome("run-1", 7)).expect("published");
            let wait = Duration::from_millis(100);
            if let Ok(sample) = tokio::time::timeout(wait, outcomes.recv_async()).await {
                break sample.expect("a sample");
            }
        }
    };
    let sample = tokio::time::timeout(WAIT, seen).await.expect("in time");
    let got: EpisodeOutcome = decode(&sample.payload().to_bytes()).expect("an outcome");
    assert_eq!(got, outcome("run-1", 7));
}

fn outcome(run: &str, episode: u32) -> EpisodeOutcome {
    EpisodeOutcome {
        run: run.into(),
        task: "widowx_spoon_on_towel".into(),
        variant: "default".into(),
        layout: None,
        seed: 1_000_000_000 + u64::from(episode),
        episode,
        strategy: "sample".into(),
        candidates: 1,
        temperature: 1.0,
        policy: "p".repeat(64),
        verifier: None,
        statistics: Statistics { is_success: episode.is_multiple_of(2), ..Statistics::default() },
        steps: 60,
        score_mean: None,
        simulator: "rever_env".into(),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_last_verifier_is_kept_for_late_subscribers() {
    let source = listen("verifiers").await;
    let connect = source.listening().to_vec();
    let options =
        NetworkOptions { connect, fleet: "verifiers".into(), ..NetworkOptions::default() };
    let reader = Network::open(options).await.expect("the network opens");
    let publisher = VerifierPublisher::declare(&source, "default").await.expect("a publisher");
    for version in 1..=3 {
        publisher.publish("policy", vec![version; 200_000]).await.expect("published");
    }
    let subscriber = VerifierSubscriber::declare(&reader, "default").await.expect("a subscriber");
    let mut latest = subscriber.latest();
    for version in [3, 4] {
        if version == 4 {
            publisher.publish("policy", vec![version; 200_000]).await.expect("published");
        }
        let is_version = |update: &Option<std::sync::Arc<protocol::VerifierUpdate>>| {
            update.as_ref().is_some_and(|update| update.weights == vec![version; 200_000])
        };
        tokio::time::timeout(WAIT, latest.wait_for(is_version))
            .await
            .expect("in time")
            .expect("a version");
    }
}
