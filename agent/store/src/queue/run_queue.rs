//! The queue of one run folder: all planned episodes without a record, in the memory of the process
//! that runs them.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Mutex, MutexGuard, PoisonError};

use anyhow::{Context, Result};
use async_trait::async_trait;
use decision::Setting;

use super::{
    ATTEMPTS_MAX, Disposition, EpisodeQueue, FaultScope, GivenUp, INTERRUPTIONS_MAX, Job, Lease,
    QueueProgress,
};
use crate::plan::EpisodePlan;
use crate::record::EpisodeIdentity;

/// Planned minus recorded episodes. Leases do not expire, because only this process holds them.
#[derive(Debug)]
pub struct RunQueue {
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<Entry>,
    leased: BTreeMap<u64, Entry>,
    completed: usize,
    given_up: Vec<GivenUp>,
    tokens: u64,
}

#[derive(Debug)]
struct Entry {
    identity: EpisodeIdentity,
    setting: Setting,
    /// Number of the episode's own faults.
    attempts: u32,
    /// Number of faults of servers and links.
    interruptions: u32,
    reasons: Vec<String>,
}

impl RunQueue {
    /// Every episode with every setting, ordered by episode so that a partial run is paired,
    /// without recorded ones.
    pub fn new(
        run: &str,
        plans: &[EpisodePlan],
        settings: &[Setting],
        recorded: &BTreeSet<String>,
    ) -> RunQueue {
        let pairs =
            plans.iter().flat_map(|plan| settings.iter().map(move |setting| (plan, *setting)));
        let mut state = State::default();
        for (plan, setting) in pairs {
            let identity = identity(run, plan, setting);
            if recorded.contains(&identity.id()) {
                state.completed += 1;
            } else {
                let (attempts, interruptions, reasons) = (0, 0, Vec::new());
                let entry = Entry { identity, setting, attempts, interruptions, reasons };
                state.waiting.push_back(entry);
            }
        }
        RunQueue { state: Mutex::new(state) }
    }

    /// A panic elsewhere cannot leave the queue in the middle of a step.
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn take_back(&mut self, lease: &Lease) -> Result<Entry> {
        self.leased.remove(&lease.token).with_context(|| {
            format!("episode {}: this worker no longer holds its lease", lease.job.identity.id())
        })
    }
}

#[async_trait]
impl EpisodeQueue for RunQueue {
    async fn lease(&self) -> Result<Option<Lease>> {
        let mut state = self.state();
        let Some(entry) = state.waiting.pop_front() else { return Ok(None) };
        state.tokens += 1;
        let token = state.tokens;
        let (identity, setting) = (entry.identity.clone(), entry.setting);
        let job = Job { identity, setting, attempt: entry.attempts + 1 };
        state.leased.insert(token, entry);
        Ok(Some(Lease { job, token }))
    }

    async fn renew(&self, lease: &Lease) -> Result<bool> {
        Ok(self.state().leased.contains_key(&lease.token))
    }

    async fn complete(&self, lease: Lease) -> Result<()> {
        let mut state = self.state();
        state.take_back(&lease)?;
        state.completed += 1;
        Ok(())
    }

    async fn fail(&self, lease: Lease, scope: FaultScope, reason: &str) -> Result<Disposition> {
        let mut state = self.state();
        let mut entry = state.take_back(&lease)?;
        entry.reasons.push(reason.to_owned());
        match scope.counts_as_attempt() {
            true => entry.attempts += 1,
            false => entry.interruptions += 1,
        }
        if entry.attempts < ATTEMPTS_MAX && entry.interruptions < INTERRUPTIONS_MAX {
            state.waiting.push_back(entry);
            return Ok(Disposition::Requeued);
        }
        state.given_up.push(GivenUp { identity: entry.identity, reasons: entry.reasons });
        Ok(Disposition::GivenUp)
    }

    async fn release(&self, lease: Lease) -> Result<()> {
        let mut state = self.state();
        let entry = state.take_back(&lease)?;
        state.waiting.push_front(entry);
        Ok(())
    }

    async fn progress(&self) -> Result<QueueProgress> {
        let state = self.state();
        Ok(QueueProgress {
            waiting: state.waiting.len(),
            leased: state.leased.len(),
            completed: state.completed,
            given_up: state.given_up.len(),
        })
    }

    async fn given_up(&self) -> Result<Vec<GivenUp>> {
        Ok(self.state().given_up.clone())
    }
}

fn identity(run: &str, plan: &EpisodePlan, setting: Setting) -> EpisodeIdentity {
    EpisodeIdentity {
        run: run.to_owned(),
        task: plan.task.task.clone(),
        variant: plan.task.variant.clone(),
        layout: plan.layout,
        episode: plan.episode,
        seed: plan.seed,
        sampling_seed: plan.sampling_seed,
        strategy: setting.strategy.to_string(),
        candidates: setting.candidates,
        temperature: setting.temperature,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use decision::{Strategy, TaskId};

    fn queue(recorded: &[&str]) -> RunQueue {
        let plan = |(episode, task): (u32, &str)| EpisodePlan {
            task: TaskId::default_of(task),
            layout: Some(episode),
            episode,
            seed: 3,
            sampling_seed: 4,
        };
        let plans = [(0, "a"), (0, "b"), (1, "a"), (1, "b")].map(plan);
        let settings = Setting::all(&[Strategy::Greedy, Strategy::Verifier], &[1.0], &[5]);
        let recorded = recorded.iter().map(|id| (*id).to_owned()).collect();
        RunQueue::new("run", &plans, &settings, &recorded)
    }

    async fn next(queue: &RunQueue) -> Lease {
        queue.lease().await.expect("a queue in memory").expect("an episode that waits")
    }

    async fn complete_all(queue: &RunQueue) -> Vec<String> {
        let mut ids = Vec::new();
        while let Some(lease) = queue.lease().await.expect("a queue in memory") {
            ids.push(lease.job.identity.id());
            queue.complete(lease).await.expect("held");
        }
        ids
    }

    #[tokio::test]
    async fn episodes_are_ordered_by_number_and_recorded_ones_are_skipped() {
        let all = complete_all(&queue(&[])).await;
        assert_eq!(all.len(), 8);
        assert_eq!(all[0], "a-default-0000-greedy-n1-t0");
        assert_eq!(all[1], "a-default-0000-verifier-n5-t1");
        assert_eq!(all[2], "b-default-0000-greedy-n1-t0");
        let queue = queue(&[&all[1], &all[6]]);
        let expected = QueueProgress { waiting: 6, completed: 2, ..QueueProgress::default() };
        assert_eq!(queue.progress().await.expect("counts"), expected);
        let rest = complete_all(&queue).await;
        assert_eq!(rest, [&all[0], &all[2], &all[3], &all[4], &all[5], &all[7]].map(Clone::clone));
        let progress = queue.progress().await.expect("counts");
        assert!(progress.is_finished());
        assert_eq!((progress.completed, progress.missing()), (8, 0));
    }

    #[tokio::test]
    async fn a_failed_episode_is_requeued_last_and_given_up_with_its_reasons() {
        let queue = queue(&[]);
        let first = next(&queue).await;
        let id = first.job.identity.id();
        let disposition = queue.fail(first, FaultScope::Episode, "nan").await.expect("held");
        assert_eq!(disposition, Disposition::Requeued);
        for (attempt, expected) in [(2, Disposition::Requeued), (3, Disposition::GivenUp)] {
            let mut lease = next(&queue).await;
            while lease.job.identity.id() != id {
                queue.complete(lease).await.expect("held");
                lease = next(&queue).await;
            }
            assert_eq!(lease.job.attempt, attempt);
            assert!(queue.lease().await.expect("a queue in memory").is_none(), "it comes last");
            assert!(!queue.progress().await.expect("counts").is_finished(), "it is being run");
            let reason = format!("nan {attempt}");
            let disposition = queue.fail(lease, FaultScope::Episode, &reason).await.expect("held");
            assert_eq!(disposition, expected);
        }
        let given_up = queue.given_up().await.expect("a list");
        assert_eq!(given_up[0].reasons, ["nan", "nan 2", "nan 3"]);
        let text = format!("{id}: given up after 3 faults, the last one: nan 3");
        assert_eq!(given_up.iter().map(GivenUp::to_string).collect::<Vec<_>>(), [text]);
        let progress = queue.progress().await.expect("counts");
        assert!(progress.is_finished());
        assert_eq!((progress.missing(), progress.planned()), (1, 8));
    }

    #[tokio::test]
    async fn faults_of_servers_and_links_use_up_no_attempt_but_have_a_limit() {
        let all = complete_all(&queue(&[])).await;
        let others: Vec<&str> = all[1..].iter().map(String::as_str).collect();
        let (queue, id) = (queue(&others), all[0].clone());
        for round in 1..=INTERRUPTIONS_MAX {
            let lease = next(&queue).await;
            assert_eq!((lease.job.identity.id(), lease.job.attempt), (id.clone(), 1));
            let scope = [FaultScope::Server, FaultScope::Link][round as usize % 2];
            let expected = match round == INTERRUPTIONS_MAX {
                true => Disposition::GivenUp,
                false => Disposition::Requeued,
            };
            assert_eq!(queue.fail(lease, scope, "gone").await.expect("held"), expected);
        }
    }

    #[tokio::test]
    async fn a_released_episode_is_next_and_a_lease_is_valid_once() {
        let queue = queue(&[]);
        let lease = next(&queue).await;
        let (id, token) = (lease.job.identity.id(), lease.token);
        assert!(queue.renew(&lease).await.expect("held"));
        queue.release(lease).await.expect("held");
        let lease = next(&queue).await;
        assert_eq!((lease.job.identity.id(), lease.job.attempt), (id.clone(), 1));
        let old = Lease { job: lease.job.clone(), token };
        assert!(!queue.renew(&old).await.expect("an answer"));
        let error = queue.complete(old).await.expect_err("of an earlier lease");
        assert_eq!(
            error.to_string(),
            format!("episode {id}: this worker no longer holds its lease")
        );
        queue.complete(lease).await.expect("held");
    }
}
