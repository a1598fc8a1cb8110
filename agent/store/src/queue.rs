//! The queue of episodes that are still to be run: leases, attempts, and what is given up.
//!
//! A worker leases an episode, renews its lease while the episode runs, and in the end completes it, fails it, or releases it
//! unbegun. Only an implementation knows who holds a lease and when one expires: the queue of a run folder lives as long as
//! its process, the queue of a fleet outlives its workers.

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

/// Faults of an episode itself after which it is given up: what fails every time is no accident.
pub const ATTEMPTS_MAX: u32 = 3;

/// Interruptions by servers and links after which an episode is given up all the same, so that one that brings down every
/// server which runs it does not hold up a run for ever.
pub const INTERRUPTIONS_MAX: u32 = 20;

/// Where planned episodes come from, and where it is noted how they ended. Every error is the queue's own.
#[async_trait]
pub trait EpisodeQueue: Send + Sync {
    /// Leases the next episode; none when nothing waits now. Leased episodes may come back, so a queue is only finished
    /// when [`QueueProgress::is_finished`].
    async fn lease(&self) -> Result<Option<Lease>>;

    /// Extends a lease; false when it is no longer held, and then its episode must be abandoned without a record.
    async fn renew(&self, lease: &Lease) -> Result<bool>;

    /// The episode ran to its end and its record is durable.
    async fn complete(&self, lease: Lease) -> Result<()>;

    /// The episode broke. It is run again after all that wait, or given up.
    async fn fail(&self, lease: Lease, scope: FaultScope, reason: &str) -> Result<Disposition>;

    /// The episode could not be begun: it is the next one again, and no attempt is lost.
    async fn release(&self, lease: Lease) -> Result<()>;

    /// How many episodes are in which state.
    async fn progress(&self) -> Result<QueueProgress>;

    /// Episodes that will not be run again, with every reason, in the order in which they were given up.
    async fn given_up(&self) -> Result<Vec<GivenUp>>;
}

/// One episode to be run with one setting.
#[derive(Debug, Clone, PartialEq)]
pub struct Job {
    /// Which episode, and how.
    pub identity: EpisodeIdentity,
    /// The same as in the identity, parsed.
    pub setting: Setting,
    /// 1 for the first attempt; interruptions do not count.
    pub attempt: u32,
}

/// The right to run one episode now. It is given back by [`EpisodeQueue::complete`], [`fail`](EpisodeQueue::fail) or
/// [`release`](EpisodeQueue::release).
#[derive(Debug, PartialEq)]
pub struct Lease {
    /// What is to be run.
    pub job: Job,
    /// Tells this lease from every other of its queue, an earlier one of the same episode included.
    token: u64,
}

/// What a fault says about the episode in which it happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FaultScope {
    /// The episode: diverged physics, a policy or a scorer that fails on it.
    Episode,
    /// Its server: crashed, frozen, or not doing what it says of itself.
    Server,
    /// The network between this process and the server.
    Link,
}

impl FaultScope {
    /// Whether such a fault uses up one of the episode's attempts.
    pub fn counts_as_attempt(self) -> bool {
        self == FaultScope::Episode
    }
}

/// What becomes of an episode that broke.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Disposition {
    /// It will be run again.
    Requeued,
    /// It will not.
    GivenUp,
}

/// How many episodes are in which state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct QueueProgress {
    /// Not leased, to be run.
    pub waiting: usize,
    /// Being run, here or elsewhere.
    pub leased: usize,
    /// With a record, those from before this process started included.
    pub completed: usize,
    /// Not to be run again by this queue.
    pub given_up: usize,
}

impl QueueProgress {
    /// Whether nothing is left to be run.
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

/// An episode that is not run again, and why.
#[derive(Debug, Clone, PartialEq)]
pub struct GivenUp {
    /// Which episode.
    pub identity: EpisodeIdentity,
    /// What happened each time, first to last.
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
