//! The server under test and its sessions.

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail, ensure};
use protocol::{
    Description, Dimension, Image, Observation, Open, PROTOCOL_VERSION, Reply, Request,
    TaskDescription, Transition, decode, encode,
};

use serde::Serialize;
use tokio::time::Instant;

use runtime::wire::{Network, Probe};

/// Tests use seeds from here on, in the tuning range, so that nothing they show is part of an
/// evaluation.
const FIRST_SEED: u64 = 2_000_000_000;

/// Maximum time for a reply, including resets.
const REPLY_WAIT: Duration = Duration::from_secs(30);
/// How long to wait for a reply that must not be sent.
pub const SILENCE: Duration = Duration::from_secs(1);
/// Maximum time for sessions of a failed test to end, and the interval of checking.
const SETTLE_WAIT_MAX: Duration = Duration::from_secs(13);
const SETTLE_LOOK: Duration = Duration::from_millis(50);
/// Side of the requested images: small, so that the tests are fast, with enough tiles for most of
/// them to stay unchanged.
const SIDE: u32 = 96;
/// How far a dimension is moved: share of its range, or in its own unit without bounds.
const SHARE: f32 = 0.02;

/// The server under test.
pub struct Subject<'a> {
    pub network: &'a Network,
    pub description: Description,
    /// Number of sessions in use without those of the current test.
    settled: AtomicU32,
}

/// A session with correctly numbered requests.
pub struct Talk {
    pub probe: Probe,
    /// The task of `reset` and `resetting`.
    pub task: TaskDescription,
    still: Vec<f32>,
    moving: Vec<f32>,
    /// Number of the last request.
    pub sequence: u64,
    /// The encodings of the last request and of its reply.
    pub request: Vec<u8>,
    pub reply: Vec<u8>,
    /// Image of the last observation, which a step's tiles are applied to.
    image: Option<Image>,
}

impl<'a> Subject<'a> {
    pub fn new(network: &'a Network, description: Description) -> Result<Subject<'a>> {
        ensure!(
            !description.tasks.is_empty(),
            "server {}: expected at least one task to test, got none",
            description.server
        );
        let settled = AtomicU32::new(description.sessions);
        Ok(Subject { network, description, settled })
    }

    /// Waits for the end of sessions that have no holder any more.
    pub async fn settle(&self) {
        let mut looks = tokio::time::interval(SETTLE_LOOK);
        let deadline = Instant::now() + SETTLE_WAIT_MAX;
        while Instant::now() < deadline {
            looks.tick().await;
            let now = self.network.describe(&self.description.server).await;
            let Ok(now) = now else { continue };
            if now.sessions <= self.settled.load(Ordering::Relaxed) {
                return;
            }
        }
        // A server that does not end its sessions is waited for only once.
        if let Ok(now) = self.network.describe(&self.description.server).await {
            self.settled.store(now.sessions, Ordering::Relaxed);
        }
    }

    /// The task for which sessions are opened.
    pub fn task(&self) -> &TaskDescription {
        &self.description.tasks[0]
    }

    /// An image side within the server's limit, which is 0 without images.
    pub fn side(&self, wanted: u32) -> u32 {
        wanted.min(self.description.image_side_max)
    }

    /// An action with little effect.
    pub fn still(&self) -> Vec<f32> {
        self.task().action.iter().map(rest).collect()
    }

    /// An action with a visible effect.
    pub fn moving(&self) -> Vec<f32> {
        let moved = |dimension: &Dimension| {
            let rest = rest(dimension);
            match (dimension.low, dimension.high) {
                (_, Some(high)) if dimension.discrete => high,
                (Some(low), Some(high)) => (rest + SHARE * (high - low)).min(high),
                (_, high) => (rest + SHARE).min(high.unwrap_or(f32::MAX)),
            }
        };
        self.task().action.iter().map(moved).collect()
    }

    pub fn open(&self) -> Open {
        Open {
            protocol: PROTOCOL_VERSION,
            task: self.task().task.clone(),
            variant: self.task().variant.clone(),
            image_height: self.side(SIDE),
            image_width: self.side(SIDE),
            expert: false,
            holder: "conformance".to_owned(),
        }
    }

    /// A session with a holder.
    pub async fn talk(&self) -> Result<Talk> {
        self.talk_with(&self.open()).await
    }

    pub async fn talk_with(&self, open: &Open) -> Result<Talk> {
        let mut probe = Probe::open(self.network, &self.description.server, open).await?;
        probe.hold().await?;
        Ok(Talk {
            probe,
            task: self.task().clone(),
            still: self.still(),
            moving: self.moving(),
            sequence: 0,
            request: Vec::new(),
            reply: Vec::new(),
            image: None,
        })
    }

    /// A session with a running episode.
    pub async fn episode(&self, index: u64) -> Result<Talk> {
        let mut talk = self.talk().await?;
        talk.reset(index).await?;
        Ok(talk)
    }
}

impl Talk {
    /// Sends the next request and returns its reply.
    pub async fn ask(&mut self, request: impl FnOnce(u64) -> Request) -> Result<Reply> {
        let sequence = self.sequence + 1;
        self.request = encode(&request(sequence))?;
        self.reply = self.answer_to(&self.request.clone()).await?;
        self.sequence = sequence;
        let mut reply: Reply = decode(&self.reply)?;
        ensure!(
            reply.sequence() == sequence,
            "expected a reply with number {sequence}, got {} with number {}",
            reply.kind(),
            reply.sequence()
        );
        self.look(&mut reply)?;
        Ok(reply)
    }

    /// Completes the reply's image, if it has one, and stores it.
    fn look(&mut self, reply: &mut Reply) -> Result<()> {
        let image = match reply {
            Reply::Observed { observation, .. } | Reply::Restored { observation, .. } => {
                &observation.image
            }
            Reply::Stepped { transition, changed_tiles, .. } => {
                let image = &mut transition.observation.image;
                if let Some(tiles) = changed_tiles.take() {
                    let last = self
                        .image
                        .take()
                        .context("expected a complete image before changed tiles")?;
                    image.complete(&tiles, last).map_err(anyhow::Error::msg)?;
                }
                image
            }
            _ => return Ok(()),
        };
        self.image = Some(image.clone());
        Ok(())
    }

    /// Sends arbitrary bytes and returns the reply.
    pub async fn answer_to(&mut self, bytes: &[u8]) -> Result<Vec<u8>> {
        self.probe.send(bytes).await?;
        let reply = self.probe.receive(REPLY_WAIT).await;
        reply.with_context(|| {
            format!("expected a reply within {} s, got none", REPLY_WAIT.as_secs())
        })
    }

    /// Sends bytes that must be refused, and returns the reason.
    pub async fn refusal_of(&mut self, bytes: &[u8], sequence: u64) -> Result<String> {
        let bytes = self.answer_to(bytes).await?;
        match decode(&bytes)? {
            Reply::Refused { sequence: got, reason } if got == sequence => Ok(reason),
            other => Err(anyhow!(
                "expected Refused with number {sequence}, got {} with number {}",
                other.kind(),
                other.sequence()
            )),
        }
    }

    /// Sends the next request, which must be refused, and returns the reason.
    pub async fn refused(&mut self, request: impl FnOnce(u64) -> Request) -> Result<String> {
        match self.ask(request).await? {
            Reply::Refused { reason, .. } => Ok(reason),
            other => Err(anyhow!("expected Refused, got {}", other.kind())),
        }
    }

    /// Starts an episode with a random layout.
    pub async fn reset(&mut self, index: u64) -> Result<Observation> {
        let request = self.resetting(None, FIRST_SEED + index);
        match self.ask(request).await? {
            Reply::Observed { observation, .. } => Ok(observation),
            other => bail!("expected Observed, got {}: {}", other.kind(), words(&other)),
        }
    }

    /// A `Reset` of the task under test.
    pub fn resetting(&self, layout: Option<u32>, seed: u64) -> impl FnOnce(u64) -> Request + use<> {
        let (task, variant) = (self.task.task.clone(), self.task.variant.clone());
        move |sequence| Request::Reset { sequence, task, variant, layout, seed }
    }

    /// Steps with an action that has little effect.
    pub async fn hold_still(&mut self) -> Result<Transition> {
        self.step(self.still.clone()).await
    }

    /// Steps with an action that has a visible effect.
    pub async fn go(&mut self) -> Result<Transition> {
        self.step(self.moving.clone()).await
    }

    async fn step(&mut self, action: Vec<f32>) -> Result<Transition> {
        match self.ask(|sequence| Request::Step { sequence, action }).await? {
            Reply::Stepped { transition, .. } => Ok(transition),
            other => bail!("expected Stepped, got {}: {}", other.kind(), words(&other)),
        }
    }

    pub async fn save(&mut self, slot: u32) -> Result<()> {
        match self.ask(|sequence| Request::Save { sequence, slot }).await? {
            Reply::Saved { .. } => Ok(()),
            other => bail!("expected Saved, got {}: {}", other.kind(), words(&other)),
        }
    }

    pub async fn restore(&mut self, slot: u32) -> Result<Observation> {
        match self.ask(|sequence| Request::Restore { sequence, slot }).await? {
            Reply::Restored { observation, .. } => Ok(observation),
            other => bail!("expected Restored, got {}: {}", other.kind(), words(&other)),
        }
    }

    pub async fn close(&mut self) -> Result<()> {
        match self.ask(|sequence| Request::Close { sequence }).await? {
            Reply::Closed { .. } => Ok(()),
            other => bail!("expected Closed, got {}: {}", other.kind(), words(&other)),
        }
    }
}

/// Zero, or the nearest valid value of the dimension.
fn rest(dimension: &Dimension) -> f32 {
    0.0f32.max(dimension.low.unwrap_or(f32::MIN)).min(dimension.high.unwrap_or(f32::MAX))
}

fn words(reply: &Reply) -> &str {
    match reply {
        Reply::Refused { reason, .. } | Reply::Faulted { reason, .. } => reason,
        _ => "",
    }
}

/// The encoding of a message that our own encoder would refuse.
pub fn unchecked(message: &impl Serialize) -> Vec<u8> {
    rmp_serde::to_vec_named(message).expect("a message can be written")
}

/// Fails unless a reason contains all parts.
pub fn names(reason: &str, parts: &[impl AsRef<str>]) -> Result<()> {
    for part in parts.iter().map(AsRef::as_ref) {
        ensure!(reason.contains(part), "expected a reason that contains {part:?}, got {reason:?}");
    }
    Ok(())
}
