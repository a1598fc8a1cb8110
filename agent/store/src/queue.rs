//! The queue of episodes to run: leases, attempts, and episodes that are given up.
//!
//! A worker leases an episode, renews the lease while the episode runs, and finally completes it,
//! fails it, or releases it without starting it. Only an implementation knows who holds a lease and
//! when it expires: the queue of a run folder exists as long as its process, the queue of a fleet
//! outlives its workers.

mod run_queue;
#[cfg(any(test, feature = "scripted"))]
mod scripted;

use std::fmt;

use anyhow::Result;
use async_trait::async_trait;
use decision::Setting;
use serde::{Deserialize, Serialize};

pub use run_queue::RunQueue;
#[cfg(any(test, feature = "scripted"))]
pub use scripted::{QueueEvent, ScriptedQueue};

use crate::record::EpisodeIdentity;

/// An episode is given up after this number of its own faults, because repeated faults are not
/// accidental.
pub const ATTEMPTS_MAX: u32 = 3;

/// An episode is given up after this number of interruptions by servers and links. An episode that
/// crashes every server must not block a run forever.
pub const INTERRUPTIONS_MAX: u32 = 20;

/// Provides planned episodes and records how they ended. Every error is an error of the queue
/// itself.
#[async_trait]
pub trait EpisodeQueue: Send + Sync {
    /// Leases the next episode, or returns `None` if no episode is waiting now. Leased episodes may
    /// return to the queue, so it is finished only when [`QueueProgress::is_finished`].
    async fn lease(&self) -> Result<Option<Lease>>;

    /// Extends a lease. False if it is no longer held: its episode must then be abandoned without a
    /// record.
    async fn renew(&self, lease: &Lease) -> Result<bool>;

    /// The episode has ended and its record is durable.
    async fn complete(&self, lease: Lease) -> Result<()>;

    /// The episode failed. It is requeued after all waiting episodes, or given up.
    async fn fail(&self, lease: Lease, scope: FaultScope, reason: &str) -> Result<Disposition>;

    /// The episode could not be started: it becomes the next one again, without using up an
    /// attempt.
    async fn release(&self, lease: Lease) -> Result<()>;

    /// The number of episodes in each state.
    async fn progress(&self) -> Result<QueueProgress>;

    /// Episodes that will not be run again, with all reasons, in the order in which they were given
    /// up.
    async fn given_up(&self) -> Result<Vec<GivenUp>>;
}

/// One episode to run with one setting.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// The episode and its setting.
    pub identity: EpisodeIdentity,
    /// The setting of the identity, parsed.
    pub setting: Setting,
    /// 1 for the first attempt; interruptions do not count.
    pub attempt: u32,
}

/// The right to run one episode now. It ends with [`EpisodeQueue::complete`],
/// [`fail`](EpisodeQueue::fail) or [`release`](EpisodeQueue::release).
#[derive(Debug, PartialEq)]
pub struct Lease {
    /// The episode to run.
    pub job: Job,
    /// Identifies this lease, also among several leases of the same episode.
    token: u64,
}

/// What a fault affects.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FaultScope {
    /// The episode: for example diverged physics, or a policy or scorer that fails on it.
    Episode,
    /// Its server: crashed, frozen, or not matching its description.
    Server,
    /// The network between this process and the server.
    Link,
}

impl FaultScope {
    /// Whether such a fault uses up an attempt of the episode.
    pub fn counts_as_attempt(self) -> bool {
        self == FaultScope::Episode
    }
}

/// What happens to an episode that failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Disposition {
    /// It will be run again.
    Requeued,
    /// It will not be run again.
    GivenUp,
}

/// The number of episodes in each state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct QueueProgress {
    /// Waiting to be run.
    pub waiting: usize,
    /// Running, here or elsewhere.
    pub leased: usize,
    /// Recorded, including those recorded before this process started.
    pub completed: usize,
    /// Not run again by this queue.
    pub given_up: usize,
}

impl QueueProgress {
    /// Whether no episode is left to run.
    pub fn is_finished(&self) -> bool {
        self.waiting == 0 && self.leased == 0
    }

    /// Episodes without a record.
    pub fn missing(&self) -> usize {
        self.waiting + self.leased + self.given_up
    }

    /// All episodes.
    pub fn planned(&self) -> usize {
        self.missing() + self.completed
    }
}

/// An episode that is not run again, with the reasons.
#[derive(Debug, Clone, PartialEq)]
pub struct GivenUp {
    /// Which episode.
    pub identity: EpisodeIdentity,
    /// The reason of each fault, first to last.
    pub reasons: Vec<String>,
}

impl fmt::Display for GivenUp {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (id, count) = (self.identity.id(), self.reasons.len());
        write!(formatter, "{id}: given up after {count} faults")?;
        match self.reasons.last() {
            Some(last) => write!(formatter, ", the last one: {last}"),
            None => Ok(()),
        }
    }
}
