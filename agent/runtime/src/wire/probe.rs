//! Direct access to a session of a server: sends and receives arbitrary bytes. For server tests.

use std::time::Duration;

use anyhow::{Context, Result, anyhow};
use protocol::{Description, Heartbeat, Open, Opening, decode, encode, transport};
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout, timeout_at};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Reliability};

use super::Network;

/// A leased session. Dropping it removes its token.
#[derive(Debug)]
pub struct Probe {
    network: Network,
    session: String,
    publisher: Publisher<'static>,
    replies: mpsc::UnboundedReceiver<Vec<u8>>,
    _subscriber: Subscriber<()>,
    token: Option<LivelinessToken>,
}

impl Probe {
    /// Requests a session with arbitrary bytes.
    pub async fn ask_to_open(network: &Network, server: &str, payload: Vec<u8>) -> Result<Opening> {
        let replies = network
            .session
            .get(network.keys.open(server)?)
            .payload(payload)
            .timeout(network.timing.open_max)
            .await
            .map_err(in_words)?;
        let reply = replies.recv_async().await.map_err(|_| anyhow!("no reply to Open"))?;
        let sample = reply
            .into_result()
            .map_err(|error| anyhow!("error reply to Open: {}", transport::in_words(error)))?;
        Ok(decode(&sample.payload().to_bytes())?)
    }

    /// Leases a session; it has no holder until `hold` is called.
    pub async fn open(network: &Network, server: &str, open: &Open) -> Result<Probe> {
        match Probe::ask_to_open(network, server, encode(open)?).await? {
            Opening::Opened { session } => Probe::attach(network, session).await,
            Opening::Refused { reason } => Err(anyhow!("expected Opened, got Refused: {reason}")),
        }
    }

    async fn attach(network: &Network, session: String) -> Result<Probe> {
        let (sender, replies) = mpsc::unbounded_channel();
        let subscriber = network
            .session
            .declare_subscriber(network.keys.reply(&session)?)
            .callback(move |sample| drop(sender.send(sample.payload().to_bytes().into_owned())))
            .await
            .map_err(in_words)?;
        let publisher = network
            .session
            .declare_publisher(network.keys.request(&session)?)
            .congestion_control(CongestionControl::Block)
            .reliability(Reliability::Reliable)
            .express(true)
            .await
            .map_err(in_words)?;
        let network = network.clone();
        Ok(Probe { network, session, publisher, replies, _subscriber: subscriber, token: None })
    }

    /// Declares the holder's token.
    pub async fn hold(&mut self) -> Result<()> {
        let key = self.network.keys.session(&self.session)?;
        let token = self.network.session.liveliness().declare_token(key).await;
        self.token = Some(token.map_err(in_words)?);
        Ok(())
    }

    /// Removes the holder's token, as if the holder had ended.
    pub async fn let_go(&mut self) -> Result<()> {
        match self.token.take() {
            Some(token) => token.undeclare().await.map_err(in_words),
            None => Ok(()),
        }
    }

    /// Sends arbitrary bytes as a request.
    pub async fn send(&self, bytes: &[u8]) -> Result<()> {
        self.publisher.put(bytes).await.map_err(in_words)
    }

    /// The bytes of the next reply, or `None` within `wait`.
    pub async fn receive(&mut self, wait: Duration) -> Option<Vec<u8>> {
        timeout(wait, self.replies.recv()).await.ok().flatten()
    }
}

impl Network {
    /// Requests the description of one server.
    pub async fn describe(&self, server: &str) -> Result<Description> {
        super::discovery::describe(self.session.clone(), self.keys.clone(), server.to_owned()).await
    }

    /// The heartbeats received from a server within `wait`.
    pub async fn heartbeats(&self, server: &str, wait: Duration) -> Result<Vec<Heartbeat>> {
        let subscriber = self
            .session
            .declare_subscriber(self.keys.heartbeat(server)?)
            .with(zenoh::handlers::FifoChannel::new(1024))
            .await
            .map_err(in_words)?;
        let deadline = Instant::now() + wait;
        let mut beats = Vec::new();
        while let Ok(Ok(sample)) = timeout_at(deadline, subscriber.recv_async()).await {
            let beat = decode(&sample.payload().to_bytes());
            beats.push(beat.context("invalid heartbeat")?);
        }
        Ok(beats)
    }
}

fn in_words(error: zenoh::Error) -> anyhow::Error {
    anyhow!("zenoh: {}", transport::in_words(error))
}
