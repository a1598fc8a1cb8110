//! Publishes newly trained verifiers to agents. zenoh keeps the last one of each name for later
//! subscribers.

use std::sync::Arc;
use std::time::Duration;

use anyhow::anyhow;
use protocol::{VerifierUpdate, decode, encode, transport};
use sha2::{Digest, Sha256};
use tokio::sync::watch;
use zenoh::qos::{CongestionControl, Reliability};
use zenoh::sample::Sample;
use zenoh_ext::{
    AdvancedPublisher, AdvancedPublisherBuilderExt, AdvancedSubscriber,
    AdvancedSubscriberBuilderExt, CacheConfig, HistoryConfig,
};

use super::Network;

/// Publishes the versions of one verifier.
#[derive(Debug)]
pub struct VerifierPublisher {
    name: String,
    publisher: AdvancedPublisher<'static>,
}

/// Holds the latest version of one verifier.
#[derive(Debug)]
pub struct VerifierSubscriber {
    latest: watch::Receiver<Option<Arc<VerifierUpdate>>>,
    _subscriber: AdvancedSubscriber<()>,
}

impl VerifierPublisher {
    /// A publisher of the verifier `name`. It must stay alive, because it serves its last update to
    /// later subscribers.
    pub async fn declare(network: &Network, name: &str) -> anyhow::Result<Self> {
        let publisher = network
            .session
            .declare_publisher(network.keys.verifier(name)?)
            .congestion_control(CongestionControl::Block)
            .reliability(Reliability::Reliable)
            .cache(CacheConfig::default().max_samples(1))
            .publisher_detection()
            .await
            .map_err(|error| {
                anyhow!("cannot publish verifier {name}: {}", transport::in_words(error))
            })?;
        Ok(Self { name: name.to_owned(), publisher })
    }

    /// Waits up to `wait` until at least one agent has subscribed to this verifier; returns whether
    /// one has.
    pub async fn wait_for_follower(&self, wait: Duration) -> anyhow::Result<bool> {
        let failed = |error| {
            anyhow!(
                "cannot detect subscribers of verifier {}: {}",
                self.name,
                transport::in_words(error)
            )
        };
        // The listener is created first, so that no subscriber is missed between the two calls.
        let listener = self.publisher.matching_listener().await.map_err(failed)?;
        if self.publisher.matching_status().await.map_err(failed)?.matching() {
            return Ok(true);
        }
        let arrival = async {
            while let Ok(status) = listener.recv_async().await {
                if status.matching() {
                    return true;
                }
            }
            false
        };
        Ok(tokio::time::timeout(wait, arrival).await.unwrap_or(false))
    }

    /// Publishes `weights` as the newest version, for agents whose policy has the digest `policy`.
    pub async fn publish(&self, policy: &str, weights: Vec<u8>) -> anyhow::Result<()> {
        let digest = digest_of(&weights);
        let update = VerifierUpdate {
            name: self.name.clone(),
            digest,
            policy: policy.to_owned(),
            weights: weights.into(),
        };
        let bytes = encode(&update)?;
        self.publisher.put(bytes).await.map_err(|error| {
            anyhow!("cannot publish verifier {}: {}", self.name, transport::in_words(error))
        })
    }
}

impl VerifierSubscriber {
    /// Subscribes to the verifier `name`; also receives its last earlier version.
    pub async fn declare(network: &Network, name: &str) -> anyhow::Result<Self> {
        let (sender, latest) = watch::channel(None);
        let subscriber = network
            .session
            .declare_subscriber(network.keys.verifier(name)?)
            .callback(move |sample| receive(&sender, &sample))
            .history(HistoryConfig::default().max_samples(1).detect_late_publishers())
            .await
            .map_err(|error| {
                anyhow!("cannot subscribe to verifier {name}: {}", transport::in_words(error))
            })?;
        Ok(Self { latest, _subscriber: subscriber })
    }

    /// A receiver of the latest version. Use it between episodes, never during one.
    pub fn latest(&self) -> watch::Receiver<Option<Arc<VerifierUpdate>>> {
        self.latest.clone()
    }
}

fn receive(sender: &watch::Sender<Option<Arc<VerifierUpdate>>>, sample: &Sample) {
    match read(sample) {
        Ok(update) => drop(sender.send_replace(Some(Arc::new(update)))),
        Err(error) => tracing::warn!(%error, "ignored an invalid verifier update"),
    }
}

fn read(sample: &Sample) -> anyhow::Result<VerifierUpdate> {
    protocol::codec::check_size::<VerifierUpdate>(sample.payload().len())?;
    let update: VerifierUpdate = decode(&sample.payload().to_bytes())?;
    let digest = digest_of(&update.weights);
    anyhow::ensure!(
        update.digest == digest,
        "expected weights with digest {}, got {digest}",
        update.digest
    );
    Ok(update)
}

fn digest_of(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}
