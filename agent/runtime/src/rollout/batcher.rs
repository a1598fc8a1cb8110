//! Decisions in batches: whatever episodes are ready share one pass of the policy.
//!
//! No episode waits for a server of another one. While a batch is decided, the episodes of the one before it are stepped
//! and come back; a batch waits for its share of them, but never for long.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use decision::{Decider, Decision, DecisionFault, DecisionRequest, EpisodeContext, Observation};
use tokio::runtime::Handle;
use tokio::sync::{Semaphore, mpsc, oneshot};
use tokio::time::{Instant, timeout_at};

/// How long a batch waits for its share of the running episodes: long enough for a step of a usual server, so that
/// batches stay even, and too short to notice a slow one.
const BATCH_WAIT: Duration = Duration::from_millis(15);
/// Batches that are decided side by side have at least so many episodes each: smaller ones share too little.
const EPISODES_MIN: usize = 3;
/// Episodes that may wait to be read; every one of them is held by a worker of its own.
const WAITING_MAX: usize = 4096;

/// Hands episodes to the decider and their decisions back.
pub struct DecisionBatcher {
    waiting: mpsc::Sender<Waiting>,
}

/// An episode that waits for its decision.
struct Waiting {
    observation: Observation,
    context: EpisodeContext,
    answer: oneshot::Sender<Answer>,
}

/// What comes back.
pub struct Answer {
    /// The episode's memory, this decision included.
    pub context: EpisodeContext,
    /// What to do.
    pub decision: Result<Decision, DecisionFault>,
    /// From the observations of the batch to its chosen actions.
    pub batch_time: Duration,
    /// Decisions that were made together.
    pub batch_size: usize,
}

impl DecisionBatcher {
    /// Starts deciding in the background; `active` is the number of episodes that are running.
    pub fn start(decider: Arc<Decider>, active: Arc<AtomicUsize>) -> DecisionBatcher {
        let (waiting, received) = mpsc::channel(WAITING_MAX);
        tokio::spawn(decide_batches(decider, received, active));
        DecisionBatcher { waiting }
    }

    /// Waits for a decision. None when the rollout is over.
    pub async fn decide(
        &self,
        observation: Observation,
        context: EpisodeContext,
    ) -> Option<Answer> {
        let (answer, answered) = oneshot::channel();
        self.waiting.send(Waiting { observation, context, answer }).await.ok()?;
        answered.await.ok()
    }
}

async fn decide_batches(
    decider: Arc<Decider>,
    mut received: mpsc::Receiver<Waiting>,
    active: Arc<AtomicUsize>,
) {
    let parallel = decider.policy().info().parallel_calls.max(1);
    let calls = Arc::new(Semaphore::new(parallel));
    loop {
        // A batch grows while it waits for its turn.
        let Ok(turn) = Arc::clone(&calls).acquire_owned().await else { return };
        let Some(first) = received.recv().await else { return };
        let batch = gather(first, &mut received, &active, parallel).await;
        let (decider, runtime) = (Arc::clone(&decider), Handle::current());
        // A policy computes on all cores for tens of milliseconds: not on a thread that others need for their steps.
        // A panic is reported by its hook, and the episodes of the batch learn that their answer will not come.
        tokio::task::spawn_blocking(move || {
            runtime.block_on(decide(&decider, batch));
            drop(turn);
        });
    }
}

/// Episodes that are ready, and those that become ready soon: a share of all that are running.
async fn gather(
    first: Waiting,
    received: &mut mpsc::Receiver<Waiting>,
    active: &AtomicUsize,
    parallel: usize,
) -> Vec<Waiting> {
    let deadline = Instant::now() + BATCH_WAIT;
    let mut batch = vec![first];
    while batch.len() < share(active.load(Ordering::Acquire), parallel) {
        match timeout_at(deadline, received.recv()).await {
            Ok(Some(next)) => batch.push(next),
            Ok(None) | Err(_) => break,
        }
    }
    batch
}

/// Episodes of one batch when so many are running.
fn share(active: usize, parallel: usize) -> usize {
    active.div_ceil((active / EPISODES_MIN).clamp(1, parallel))
}

async fn decide(decider: &Decider, mut batch: Vec<Waiting>) {
    let begun = Instant::now();
    let requests = batch
        .iter_mut()
        .map(|one| DecisionRequest { observation: &one.observation, context: &mut one.context })
        .collect();
    let decisions = decider.decide(requests).await;
    let (batch_time, batch_size) = (begun.elapsed(), batch.len());
    for (one, decision) in batch.into_iter().zip(decisions) {
        let answer = Answer { context: one.context, decision, batch_time, batch_size };
        // The episode may have been dropped meanwhile.
        let _ = one.answer.send(answer);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batches_side_by_side_share_the_running_episodes_and_few_episodes_stay_together() {
        let shares = |parallel: usize| [1, 2, 5, 6, 8, 16].map(|active| share(active, parallel));
        assert_eq!(shares(1), [1, 2, 5, 6, 8, 16]);
        assert_eq!(shares(2), [1, 2, 5, 3, 4, 8]);
        assert_eq!(shares(16), [1, 2, 5, 3, 4, 4]);
    }
}
