//! A scripted queue that records all calls, for the tests of crates that run episodes.

use std::collections::{BTreeSet, VecDeque};
use std::sync::{Mutex, MutexGuard, PoisonError};

use anyhow::{Result, bail};
use async_trait::async_trait;

use super::{Disposition, EpisodeQueue, FaultScope, GivenUp, Job, Lease, QueueProgress};

/// A call of a [`ScriptedQueue`], with the id of its episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum QueueEvent {
    /// Leased to a worker.
    Leased(String),
    /// Ended.
    Completed(String),
    /// Failed.
    Failed(String, FaultScope, String),
    /// Could not be started.
    Released(String),
}

/// Leases each job once, in order; an episode that fails is given up at once.
#[derive(Debug, Default)]
pub struct ScriptedQueue {
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<Job>,
    leased: BTreeSet<u64>,
    completed: usize,
    given_up: Vec<GivenUp>,
    lost: BTreeSet<String>,
    error: Option<String>,
    events: Vec<QueueEvent>,
    tokens: u64,
}

impl ScriptedQueue {
    /// A queue of these jobs.
    pub fn new(jobs: impl IntoIterator<Item = Job>) -> ScriptedQueue {
        let state = State { waiting: jobs.into_iter().collect(), ..State::default() };
        ScriptedQueue { state: Mutex::new(state) }
    }

    /// From now on another worker holds the lease of this episode.
    pub fn lose(&self, id: &str) {
        self.state().lost.insert(id.to_owned());
    }

    /// From now on every call fails with this error; `None` ends that.
    pub fn break_with(&self, error: Option<&str>) {
        self.state().error = error.map(str::to_owned);
    }

    /// All calls so far that changed the queue.
    pub fn events(&self) -> Vec<QueueEvent> {
        self.state().events.clone()
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn answer(&self) -> Result<MutexGuard<'_, State>> {
        let state = self.state();
        match &state.error {
            Some(error) => bail!("{error}"),
            None => Ok(state),
        }
    }

    fn take_back(&self, lease: &Lease) -> Result<(MutexGuard<'_, State>, String)> {
        let (mut state, id) = (self.answer()?, lease.job.identity.id());
        if !state.leased.remove(&lease.token) || state.lost.contains(&id) {
            bail!("episode {id}: this worker no longer holds its lease");
        }
        Ok((state, id))
    }
}

#[async_trait]
impl EpisodeQueue for ScriptedQueue {
    async fn lease(&self) -> Result<Option<Lease>> {
        let mut state = self.answer()?;
        let Some(job) = state.waiting.pop_front() else { return Ok(None) };
        state.tokens += 1;
        let token = state.tokens;
        state.leased.insert(token);
        state.events.push(QueueEvent::Leased(job.identity.id()));
        Ok(Some(Lease { job, token }))
    }

    async fn renew(&self, lease: &Lease) -> Result<bool> {
        let state = self.answer()?;
        let is_lost = state.lost.contains(&lease.job.identity.id());
        Ok(state.leased.contains(&lease.token) && !is_lost)
    }

    async fn complete(&self, lease: Lease) -> Result<()> {
        let (mut state, id) = self.take_back(&lease)?;
        state.completed += 1;
        state.events.push(QueueEvent::Completed(id));
        Ok(())
    }

    async fn fail(&self, lease: Lease, scope: FaultScope, reason: &str) -> Result<Disposition> {
        let (mut state, id) = self.take_back(&lease)?;
        let reasons = vec![reason.to_owned()];
        state.given_up.push(GivenUp { identity: lease.job.identity, reasons });
        state.events.push(QueueEvent::Failed(id, scope, reason.to_owned()));
        Ok(Disposition::GivenUp)
    }

    async fn release(&self, lease: Lease) -> Result<()> {
        let (mut state, id) = self.take_back(&lease)?;
        state.waiting.push_front(lease.job);
        state.events.push(QueueEvent::Released(id));
        Ok(())
    }

    async fn progress(&self) -> Result<QueueProgress> {
        let state = self.answer()?;
        Ok(QueueProgress {
            waiting: state.waiting.len(),
            leased: state.leased.len(),
            completed: state.completed,
            given_up: state.given_up.len(),
        })
    }

    async fn given_up(&self) -> Result<Vec<GivenUp>> {
        Ok(self.answer()?.given_up.clone())
    }
}
