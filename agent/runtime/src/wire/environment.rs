//! A leased session of a server: numbered requests, each with one reply, over a network that may
//! lose messages.

use std::time::Duration;

use protocol::{Image, Open, Opening, Reply, Request, Reset, decode, encode};
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;
use zenoh::bytes::ZBytes;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Reliability};

use super::discovery::ServerStatus;
use super::{Episode, Network, Timing};
use crate::fault::EnvironmentFault;
use crate::session;

/// Maximum number of queued replies: the awaited one and late copies. More are dropped, because the
/// server sends a reply again on request.
const REPLIES_MAX: usize = 16;
/// The first reset and the first step: during these, simulators compile code and make no progress.
const FIRST_REQUESTS: u64 = 2;

/// A session between episodes. Dropping it ends the session on the server.
#[derive(Debug)]
pub struct Environment {
    server: String,
    session: String,
    image_height: usize,
    image_width: usize,
    has_expert: bool,
    timing: Timing,
    network: Network,
    /// Number of the last request.
    sequence: u64,
    /// The encoding of the last request.
    request: ZBytes,
    /// Number of losses of the server's token when the session was opened.
    losses: u32,
    status: watch::Receiver<ServerStatus>,
    replies: mpsc::Receiver<ZBytes>,
    /// Size of the last awaited reply.
    pub(super) reply_bytes: usize,
    publisher: Publisher<'static>,
    _subscriber: Subscriber<()>,
    _token: LivelinessToken,
}

impl Environment {
    /// Leases a session of `server`.
    pub async fn open(
        network: &Network,
        server: &str,
        open: Open,
    ) -> Result<Self, EnvironmentFault> {
        let status = network.discovery.status(server);
        let losses = status.borrow().losses;
        let session = ask_for_session(network, server, &open).await?;
        let (sender, replies) = mpsc::channel(REPLIES_MAX);
        let keys = &network.keys;
        let on_reply = move |sample: zenoh::sample::Sample| {
            // A full channel contains only late copies; the awaited reply is requested again.
            let _ = sender.try_send(sample.payload().clone());
        };
        let subscriber = network
            .session
            .declare_subscriber(keys.reply(&session).map_err(EnvironmentFault::wire)?)
            .callback(on_reply)
            .await
            .map_err(EnvironmentFault::wire)?;
        let publisher = network
            .session
            .declare_publisher(keys.request(&session).map_err(EnvironmentFault::wire)?)
            .congestion_control(CongestionControl::Block)
            .reliability(Reliability::Reliable)
            .express(true)
            .await
            .map_err(EnvironmentFault::wire)?;
        let token = network
            .session
            .liveliness()
            .declare_token(keys.session(&session).map_err(EnvironmentFault::wire)?)
            .await
            .map_err(EnvironmentFault::wire)?;
        Ok(Self {
            server: server.to_owned(),
            session,
            image_height: open.image_height as usize,
            image_width: open.image_width as usize,
            has_expert: open.expert,
            timing: network.timing,
            network: network.clone(),
            sequence: 0,
            request: ZBytes::new(),
            losses,
            status,
            replies,
            reply_bytes: 0,
            publisher,
            _subscriber: subscriber,
            _token: token,
        })
    }

    /// The server's id.
    pub fn server(&self) -> &str {
        &self.server
    }

    /// The session's id.
    pub fn session(&self) -> &str {
        &self.session
    }

    /// Whether observations include the scripted expert's action.
    pub fn has_expert(&self) -> bool {
        self.has_expert
    }

    /// Starts an episode. After an error the session is lost: open another one.
    pub async fn reset(mut self, reset: Reset) -> Result<Episode, EnvironmentFault> {
        let Reset { task, variant, layout, seed } = reset;
        let request = |sequence| Request::Reset { sequence, task, variant, layout, seed };
        match self.ask("Reset", request).await? {
            Reply::Observed { observation, .. } => Episode::new(self, observation),
            other => Err(unexpected("Observed", &other)),
        }
    }

    /// Ends the session and waits for the server's confirmation.
    pub async fn close(mut self) -> Result<(), EnvironmentFault> {
        match self.ask("Close", |sequence| Request::Close { sequence }).await? {
            Reply::Closed { .. } => Ok(()),
            other => Err(unexpected("Closed", &other)),
        }
    }

    pub(super) fn check_image(&self, image: &Image) -> Result<(), EnvironmentFault> {
        if (image.height, image.width) == (self.image_height, self.image_width) {
            return Ok(());
        }
        Err(EnvironmentFault::wire(format!(
            "expected an image of {} x {} pixels, got {} x {}",
            self.image_height, self.image_width, image.height, image.width
        )))
    }

    /// Sends the next request, repeatedly, until its reply arrives or the server cannot give one.
    pub(super) async fn ask(
        &mut self,
        asked: &'static str,
        request: impl FnOnce(u64) -> Request,
    ) -> Result<Reply, EnvironmentFault> {
        let sequence = self.sequence + 1;
        let bytes = encode(&request(sequence)).map_err(|error| EnvironmentFault::unsent(&error))?;
        self.request = ZBytes::from(bytes);
        self.refuse_early_replies(sequence)?;
        self.sequence = sequence;
        self.ask_again(asked).await
    }

    /// Empties the channel before a request is sent: it may contain late copies of earlier replies.
    /// A reply to the new request at this point would be a forgery or a defect.
    fn refuse_early_replies(&mut self, sequence: u64) -> Result<(), EnvironmentFault> {
        while let Ok(payload) = self.replies.try_recv() {
            let reply: Reply = read(&payload)?;
            if reply.sequence() >= sequence {
                return Err(early(&reply));
            }
        }
        Ok(())
    }

    /// Sends the last request again until its reply arrives. A server that has already replied
    /// sends the same bytes and does nothing else.
    pub(super) async fn ask_again(
        &mut self,
        asked: &'static str,
    ) -> Result<Reply, EnvironmentFault> {
        let asked_at = Instant::now();
        let mut resend = self.timing.resend;
        loop {
            self.check_server(asked, asked_at).await?;
            self.publisher.put(self.request.clone()).await.map_err(EnvironmentFault::wire)?;
            if let Some(reply) = self.reply_within(resend, asked, asked_at).await? {
                return match reply {
                    Reply::Refused { reason, .. } => Err(EnvironmentFault::refused(&reason)),
                    Reply::Faulted { kind, reason, .. } => {
                        Err(EnvironmentFault::faulted(kind, &reason))
                    }
                    reply => Ok(reply),
                };
            }
            resend = (resend * 2).min(self.timing.resend_max);
        }
    }

    /// The reply to the last request, or `None` within `wait`. Late replies to earlier requests are
    /// dropped.
    async fn reply_within(
        &mut self,
        wait: Duration,
        asked: &'static str,
        asked_at: Instant,
    ) -> Result<Option<Reply>, EnvironmentFault> {
        let deadline = Instant::now() + wait;
        loop {
            tokio::select! {
                biased;
                payload = self.replies.recv() => {
                    let payload = payload.ok_or_else(|| EnvironmentFault::wire("the network is closed"))?;
                    let reply = read(&payload)?;
                    if reply.sequence() > self.sequence {
                        return Err(early(&reply));
                    }
                    // Number 0 refers to the session itself or to a request that could not be
                    // decoded.
                    if reply.sequence() == self.sequence || reply.sequence() == 0 {
                        self.reply_bytes = payload.len();
                        return Ok(Some(reply));
                    }
                }
                // An error here means that the network is closed; receiving the next reply reports
                // it.
                Ok(()) = self.status.changed() => self.check_server(asked, asked_at).await?,
                () = tokio::time::sleep_until(deadline) => return Ok(None),
            }
        }
    }

    /// How long the server's heartbeat may be missing now.
    fn silence_max(&self) -> Duration {
        let Timing { silence_max, open_max, .. } = self.timing;
        if self.sequence <= FIRST_REQUESTS { silence_max.max(open_max) } else { silence_max }
    }

    async fn check_server(
        &mut self,
        asked: &'static str,
        asked_at: Instant,
    ) -> Result<(), EnvironmentFault> {
        let status = *self.status.borrow_and_update();
        if status.losses != self.losses {
            self.await_return().await?;
        }
        let waited = asked_at.elapsed();
        // Heartbeats start with the server; the first one may arrive after our first request.
        let silent = status.beaten_at.map_or(waited, |beaten_at| beaten_at.elapsed().min(waited));
        if silent > self.silence_max() || waited > self.timing.reply_max {
            let waited_secs = waited.as_secs();
            return Err(EnvironmentFault::TimedOut {
                server: self.server.clone(),
                asked,
                waited_secs,
            });
        }
        Ok(())
    }
}

impl Environment {
    /// Waits for a lost token to reappear: the connection may have failed instead of the server. If
    /// it reappears within the time for which a server keeps a session, the session continues.
    async fn await_return(&mut self) -> Result<(), EnvironmentFault> {
        let server = self.server.clone();
        if !self.network.is_remote() {
            return Err(EnvironmentFault::ServerLost { server });
        }
        let returned = self.status.wait_for(|status| status.alive);
        let returned = tokio::time::timeout(self.timing.link_max, returned).await;
        // The guard of the status must not be held during the next wait.
        match returned.map(|status| status.map(|status| status.losses)) {
            Ok(Ok(losses)) => {
                self.losses = losses;
                Ok(())
            }
            Ok(Err(_)) => Err(EnvironmentFault::wire("the network is closed")),
            Err(_) if self.network.is_connected().await => {
                Err(EnvironmentFault::ServerLost { server })
            }
            Err(_) => Err(EnvironmentFault::LinkLost { server }),
        }
    }
}

/// Decodes a reply after checking its size.
fn read(payload: &ZBytes) -> Result<Reply, EnvironmentFault> {
    protocol::codec::check_size::<Reply>(payload.len()).map_err(EnvironmentFault::wire)?;
    decode(&payload.to_bytes()).map_err(EnvironmentFault::wire)
}

/// The fault for a reply to a request that has not been sent.
fn early(reply: &Reply) -> EnvironmentFault {
    EnvironmentFault::wire(format!(
        "expected no reply to request {} before it was sent, got {}",
        reply.sequence(),
        reply.kind()
    ))
}

/// The fault for a reply that does not match its request.
pub(super) fn unexpected(expected: &str, reply: &Reply) -> EnvironmentFault {
    EnvironmentFault::wire(format!("expected the reply {expected}, got {}", reply.kind()))
}

async fn ask_for_session(
    network: &Network,
    server: &str,
    open: &Open,
) -> Result<String, EnvironmentFault> {
    let asked_at = Instant::now();
    let payload = encode(open).map_err(|error| EnvironmentFault::unsent(&error))?;
    let key = network.keys.open(server).map_err(EnvironmentFault::wire)?;
    let mut status = network.discovery.status(server);
    let losses = status.borrow().losses;
    let lost = status.wait_for(|status| status.losses != losses);
    let replies = network
        .session
        .get(key)
        .payload(payload)
        .timeout(network.timing.open_max)
        .await
        .map_err(EnvironmentFault::wire)?;
    let reply = tokio::select! {
        reply = replies.recv_async() => reply,
        _ = lost => return Err(EnvironmentFault::ServerLost { server: server.to_owned() }),
    };
    let Ok(Ok(sample)) = reply.map(zenoh::query::Reply::into_result) else {
        // zenoh does not distinguish a timeout from a missing server.
        let waited_secs = asked_at.elapsed().as_secs();
        return Err(EnvironmentFault::TimedOut {
            server: server.to_owned(),
            asked: "Open",
            waited_secs,
        });
    };
    protocol::codec::check_size::<Opening>(sample.payload().len())
        .map_err(EnvironmentFault::wire)?;
    match decode(&sample.payload().to_bytes()).map_err(EnvironmentFault::wire)? {
        Opening::Opened { session } => Ok(session),
        Opening::Refused { reason } => Err(EnvironmentFault::refused(&reason)),
    }
}

impl session::Environment for Environment {
    type Episode = Episode;

    async fn reset(self, reset: Reset) -> Result<Episode, EnvironmentFault> {
        Environment::reset(self, reset).await
    }
}
