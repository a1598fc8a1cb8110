//! The stream of episode outcomes, with a cache at its source for those who come late or miss some.

use std::collections::BTreeSet;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, anyhow};
use protocol::{EpisodeOutcome, decode, encode};
use tokio::sync::mpsc;
use tokio::sync::mpsc::error::TrySendError;
use zenoh::qos::{CongestionControl, Reliability};
use zenoh::query::{ConsolidationMode, QueryTarget, ReplyKeyExpr};
use zenoh::sample::Sample;
use zenoh::{Session, Wait};
use zenoh_ext::{
    AdvancedPublisher, AdvancedPublisherBuilderExt, AdvancedSubscriber,
    AdvancedSubscriberBuilderExt, CacheConfig, HistoryConfig, MissDetectionConfig, RecoveryConfig,
};

use super::Network;

/// Outcomes that a publisher keeps for others; older ones are in the run's records alone.
const CACHED_MAX: usize = 16_384;
/// Outcomes that may wait to be read. All that is cached comes before the declaration returns and
/// anybody can read, so this must hold the caches of several runs.
const UNREAD_MAX: usize = 8 * CACHED_MAX;
/// How soon a subscriber learns that it missed the last outcome.
const MISS_DETECTION: Duration = Duration::from_millis(500);

/// Publishes the outcomes of one run.
#[derive(Debug)]
pub struct OutcomePublisher {
    run: String,
    publisher: AdvancedPublisher<'static>,
}

/// Receives the outcomes of one run, or of all.
#[derive(Debug)]
pub struct OutcomeSubscriber {
    outcomes: mpsc::Receiver<EpisodeOutcome>,
    _subscriber: AdvancedSubscriber<()>,
}

impl OutcomePublisher {
    /// For the outcomes of `run`.
    pub async fn declare(network: &Network, run: &str) -> anyhow::Result<Self> {
        let publisher = network
            .session
            .declare_publisher(network.keys.outcome(run)?)
            .congestion_control(CongestionControl::Block)
            .reliability(Reliability::Reliable)
            .cache(CacheConfig::default().max_samples(CACHED_MAX))
            .sample_miss_detection(
                MissDetectionConfig::default().sporadic_heartbeat(MISS_DETECTION),
            )
            .publisher_detection()
            .await
            .map_err(|error| anyhow!("cannot publish the outcomes of run {run}: {error}"))?;
        Ok(Self { run: run.to_owned(), publisher })
    }

    /// Publishes one outcome of the run.
    pub async fn publish(&self, outcome: &EpisodeOutcome) -> anyhow::Result<()> {
        anyhow::ensure!(
            outcome.run == self.run,
            "expected an outcome of run {}, got one of {}",
            self.run,
            outcome.run
        );
        let bytes = encode(outcome)?;
        self.publisher
            .put(bytes)
            .await
            .map_err(|error| anyhow!("cannot publish an outcome: {error}"))
    }
}

impl OutcomeSubscriber {
    /// The outcomes of `run`, or of every run of the fleet; past ones too, in no certain order.
    pub async fn declare(network: &Network, run: Option<&str>) -> anyhow::Result<Self> {
        let key =
            run.map_or_else(|| Ok(network.keys.outcomes()), |run| network.keys.outcome(run))?;
        let (sender, outcomes) = mpsc::channel(UNREAD_MAX);
        let beginnings = Beginnings { session: network.session.clone(), known: Mutex::default() };
        let subscriber = network
            .session
            .declare_subscriber(key)
            .callback(move |sample| {
                beginnings.fetch(&sample, &sender);
                receive(&sender, &sample);
            })
            .history(HistoryConfig::default().detect_late_publishers())
            .recovery(RecoveryConfig::default().heartbeat())
            .await
            .map_err(|error| anyhow!("cannot subscribe to outcomes: {error}"))?;
        Ok(Self { outcomes, _subscriber: subscriber })
    }

    /// The next outcome.
    pub async fn next(&mut self) -> anyhow::Result<EpisodeOutcome> {
        self.outcomes.recv().await.context("the network is closed")
    }
}

/// Fetches what a publisher sent before it knew of the subscriber.
///
/// zenoh-ext takes the first sample that it sees of a new publisher for the publisher's first, and
/// then drops the earlier ones as repetitions when the cache brings them.
struct Beginnings {
    session: Session,
    /// Publishers of which a sample came.
    known: Mutex<BTreeSet<(String, u32)>>,
}

impl Beginnings {
    /// Asks for all that came before `sample`, if it is the first one of its publisher.
    fn fetch(&self, sample: &Sample, sender: &mpsc::Sender<EpisodeOutcome>) {
        let Some(source) = sample.source_info() else { return };
        let (zid, eid) = (source.source_id().zid().to_string(), source.source_id().eid());
        // Where zenoh-ext's cache of one publisher answers.
        let cache = format!("{}/@adv/*/{zid}/{eid}/**", sample.key_expr());
        let is_new = self.known.lock().unwrap_or_else(PoisonError::into_inner).insert((zid, eid));
        let Some(last) = source.source_sn().checked_sub(1).filter(|_| is_new) else { return };
        let sender = sender.clone();
        let asked = self
            .session
            .get(format!("{cache}?_sn=0..{last}"))
            .callback(move |reply| {
                if let Ok(sample) = reply.result() {
                    receive(&sender, sample);
                }
            })
            .consolidation(ConsolidationMode::None)
            .accept_replies(ReplyKeyExpr::Any)
            .target(QueryTarget::All)
            .wait();
        if let Err(error) = asked {
            tracing::warn!(%error, "the first outcomes of {} may be missing", sample.key_expr());
        }
    }
}

fn receive(sender: &mpsc::Sender<EpisodeOutcome>, sample: &Sample) {
    if let Err(error) = protocol::codec::check_size::<EpisodeOutcome>(sample.payload().len()) {
        return tracing::warn!(%error, "an outcome was refused");
    }
    let outcome = match decode::<EpisodeOutcome>(&sample.payload().to_bytes()) {
        Ok(outcome) => outcome,
        Err(error) => return tracing::warn!(%error, "an outcome was refused"),
    };
    // Waiting here would hold up the network, and with it the steps of every episode.
    if let Err(TrySendError::Full(outcome)) = sender.try_send(outcome) {
        tracing::error!(
            run = outcome.run,
            episode = outcome.episode,
            "an outcome is lost: nobody reads them"
        );
    }
}
