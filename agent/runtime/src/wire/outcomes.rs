//! The stream of episode outcomes for observers, such as dashboards and the progress display of a
//! fleet.
//!
//! An outcome is published after its record and label are written. Nothing waits for a reader.

use anyhow::anyhow;
use protocol::{EpisodeOutcome, encode, transport};
use zenoh::Wait;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

use super::Network;

/// Publishes the outcomes of one run.
#[derive(Debug)]
pub struct OutcomePublisher {
    publisher: Publisher<'static>,
}

impl OutcomePublisher {
    /// A publisher for the outcomes of `run`.
    pub async fn declare(network: &Network, run: &str) -> anyhow::Result<Self> {
        let publisher = network
            .session
            .declare_publisher(network.keys.outcome(run)?)
            .congestion_control(CongestionControl::Drop)
            .await
            .map_err(|error| {
                anyhow!("cannot publish the outcomes of run {run}: {}", transport::in_words(error))
            })?;
        Ok(Self { publisher })
    }

    /// Publishes one outcome; a slow observer may miss it.
    pub fn publish(&self, outcome: &EpisodeOutcome) -> anyhow::Result<()> {
        let bytes = encode(outcome)?;
        self.publisher
            .put(bytes)
            .wait()
            .map_err(|error| anyhow!("cannot publish an outcome: {}", transport::in_words(error)))
    }
}
