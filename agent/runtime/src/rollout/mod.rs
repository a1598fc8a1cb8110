//! Rollouts: many concurrent episodes, each at its own pace, with one policy that decides for all
//! episodes that are ready.
//!
//! ```text
//! EpisodeQueue ─lease─▶ worker ─▶ SessionPool ─▶ Environment::reset ─▶ Episode ─┐
//!                         │  ┌──────────── observation ◀────────────────────────┤
//!                         │  └▶ DecisionBatcher (Decider) ─▶ actions ─▶ step ───┘
//!                         └─▶ EpisodeRecord ─▶ event sinks
//! ```
//!
//! Settings may share a batch, because a decision does not depend on the other episodes of the
//! batch. A failed attempt is dropped, recorded as a fault and repeated; only an episode that ended
//! is recorded.

mod episode;
mod first_decisions;

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::{Context, Result};
use batching::DecisionBatcher;
use decision::{Decider, Scorer};
use store::queue::{Disposition, EpisodeQueue, Lease};
use store::record::{EpisodeRecord, Versions};
use store::run::FaultRecord;
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;

use crate::fault::AttemptFault;
use crate::session::{Session, SessionInfo, SessionPool, SessionRequest};
use crate::sinks::{Event, Sinks};
use crate::stop::{Stop, asked};
use episode::EpisodeRun;
use first_decisions::FirstDecisions;
pub use first_decisions::{NeverWellFormed, first_malformed};

/// Optional content of records.
#[derive(Debug, Clone, Copy, Default)]
pub struct RecordOptions {
    /// Record the hidden states of all candidates, not only of the executed one.
    pub all_hidden: bool,
    /// Record a video of every episode.
    pub video: bool,
    /// Record reasoning and confidence of candidates, for a policy whose tokens cannot be decoded.
    pub readings: bool,
}

/// Everything that a rollout uses.
pub struct Rollout<P> {
    /// Makes the decisions.
    pub decider: Arc<Decider>,
    /// The newest scorer; an episode keeps the scorer that it started with.
    pub scorer: watch::Receiver<Option<Arc<dyn Scorer>>>,
    /// Opens sessions.
    pub pool: P,
    /// The episodes to run.
    pub queue: Arc<dyn EpisodeQueue>,
    /// Receive the events.
    pub sinks: Sinks,
    /// Maximum number of concurrent episodes.
    pub sessions: usize,
    /// Optional content of records.
    pub options: RecordOptions,
    /// End the run if no candidate of its first decisions is well formed. A benchmark runs on.
    pub needs_well_formed: bool,
    /// The versions in records; simulator, policy and verifier are filled in.
    pub versions: Versions,
    /// Checked between episodes.
    pub stop: watch::Receiver<Stop>,
}

impl<P: SessionPool> Rollout<P> {
    /// Runs until the queue is finished or the run is stopped. All records are durable when this
    /// returns.
    pub async fn run(self) -> Result<()> {
        let stop = self.stop.clone();
        let sessions = self.sessions;
        let batcher = DecisionBatcher::start(Arc::clone(&self.decider));
        let first_decisions = FirstDecisions::new(self.needs_well_formed);
        let shared = Arc::new(Shared {
            rollout: self,
            batcher,
            first_decisions,
            leased: AtomicUsize::new(0),
            returned: Notify::new(),
        });
        let mut workers = JoinSet::new();
        for _ in 0..sessions {
            let shared = Arc::clone(&shared);
            workers.spawn(async move { shared.work().await });
        }
        let finished = async {
            while let Some(worker) = workers.join_next().await {
                worker.context("an episode's worker panicked")??;
            }
            Ok(())
        };
        let result = tokio::select! {
            result = finished => result,
            () = asked(stop, Stop::Now) => Ok(()),
        };
        workers.shutdown().await;
        let shared = Arc::into_inner(shared).context("a worker outlived the rollout")?;
        // The reason why the run ended takes precedence over errors of the sinks.
        result.and(shared.rollout.sinks.finish().await)
    }
}

/// The state shared by the workers.
struct Shared<P> {
    rollout: Rollout<P>,
    batcher: DecisionBatcher,
    first_decisions: FirstDecisions,
    /// Number of leases held by workers.
    leased: AtomicUsize,
    /// Notified when a lease was completed, failed or released.
    returned: Notify,
}

impl<P: SessionPool> Shared<P> {
    async fn work(&self) -> Result<()> {
        while let Some(lease) = self.next_lease().await? {
            let result = self.run_lease(lease).await;
            self.leased.fetch_sub(1, Ordering::AcqRel);
            self.returned.notify_waiters();
            result?;
        }
        Ok(())
    }

    /// The next episode; `None` if none is left or the run is stopping.
    async fn next_lease(&self) -> Result<Option<Lease>> {
        loop {
            let returned = self.returned.notified();
            if *self.rollout.stop.borrow() != Stop::No {
                return Ok(None);
            }
            self.leased.fetch_add(1, Ordering::AcqRel);
            if let Some(lease) = self.rollout.queue.lease().await? {
                return Ok(Some(lease));
            }
            // Leases of other workers may fail and return to the queue.
            if self.leased.fetch_sub(1, Ordering::AcqRel) == 1 {
                self.returned.notify_waiters();
                return Ok(None);
            }
            returned.await;
        }
    }

    async fn run_lease(&self, lease: Lease) -> Result<()> {
        let Rollout { pool, queue, sinks, .. } = &self.rollout;
        let request = SessionRequest {
            task: lease.job.identity.task_id(),
            needs_expert: lease.job.setting.strategy.needs_expert(),
        };
        let stop = self.rollout.stop.clone();
        let session = tokio::select! {
            session = pool.acquire(&request) => session?,
            () = asked(stop, Stop::Finish) => return queue.release(lease).await,
        };
        let info = session.info.clone();
        match self.attempt(&lease, session).await {
            Ok((record, environment)) => {
                if !record.has_outcome() {
                    sinks.emit(Event::Notice(never_acted(&record))).await?;
                }
                sinks.record(record).await?;
                pool.release(Session { info, environment });
                queue.complete(lease).await
            }
            Err(AttemptFault::NeverWellFormed(fault)) => {
                self.note_fault(lease, &info, fault.clone().into()).await?;
                Err(fault.into())
            }
            Err(fault) => self.note_fault(lease, &info, fault).await,
        }
    }

    async fn attempt(
        &self,
        lease: &Lease,
        session: Session<P::Environment>,
    ) -> Result<(EpisodeRecord, P::Environment), AttemptFault> {
        let run = EpisodeRun {
            lease,
            options: self.rollout.options,
            versions: &self.rollout.versions,
            policy: self.rollout.decider.policy().as_ref(),
            first_decisions: &self.first_decisions,
            scorer: self.rollout.scorer.borrow().clone(),
            batcher: &self.batcher,
            sinks: &self.rollout.sinks,
            pool: &self.rollout.pool,
        };
        let _active = self.batcher.activate();
        run.run(session).await
    }

    async fn note_fault(
        &self,
        lease: Lease,
        info: &SessionInfo,
        fault: AttemptFault,
    ) -> Result<()> {
        let record = FaultRecord {
            identity: lease.job.identity.clone(),
            attempt: lease.job.attempt,
            server: info.server.clone(),
            scope: fault.scope(),
            reason: fault.to_string(),
        };
        let id = record.identity.id();
        self.rollout.sinks.emit(Event::Faulted(record)).await?;
        let disposition = self.rollout.queue.fail(lease, fault.scope(), &fault.to_string()).await?;
        if disposition == Disposition::GivenUp {
            let notice = format!("{id} is given up: {fault}");
            self.rollout.sinks.emit(Event::Notice(notice)).await?;
        }
        Ok(())
    }
}

/// The notice about an episode in which the robot held still from start to end.
fn never_acted(record: &EpisodeRecord) -> String {
    let decisions = record.decisions().count();
    let first = record.decisions().flat_map(|decision| &decision.candidates).next();
    let reason = first.and_then(|candidate| candidate.malformed.as_deref()).unwrap_or("none");
    format!(
        "{}: the policy never acted, because none of {decisions} decisions had a well-formed \
         candidate; the episode has no outcome; first candidate: {reason}",
        record.identity.id()
    )
}

#[cfg(test)]
mod tests;
