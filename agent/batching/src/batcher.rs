//! Batches decisions: all episodes that are ready share one forward pass of the policy.
//!
//! No episode waits for another one's simulator or client. While a batch is computed, the episodes of the
//! previous batch execute their steps. A batch waits for its share of the running episodes, but
//! only for a short time.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use decision::{Decider, Decision, DecisionFault, DecisionRequest, EpisodeContext, Observation};
use tokio::runtime::Handle;
use tokio::sync::{Semaphore, mpsc, oneshot};
use tokio::time::{Instant, timeout_at};

/// Maximum wait of a batch for its share of the running episodes: long enough for a step of a
/// typical server, so that batches have equal sizes, and short compared with a slow server.
const BATCH_WAIT: Duration = Duration::from_millis(15);
/// Minimum number of episodes in each of several parallel batches; smaller batches share too little
/// work.
const EPISODES_MIN: usize = 3;
/// Maximum number of episodes in the queue; each one is held by its own worker.
const WAITING_MAX: usize = 4096;

/// Passes episodes to the decider and returns their decisions.
pub struct DecisionBatcher {
    waiting: mpsc::Sender<Waiting>,
    active: Arc<AtomicUsize>,
}

/// Counts an episode as running until it is dropped.
pub struct Active(Arc<AtomicUsize>);

impl Drop for Active {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

/// An episode waiting for its decision.
struct Waiting {
    observation: Observation,
    context: EpisodeContext,
    answer: oneshot::Sender<Answer>,
}

/// The result for one episode.
pub struct Answer {
    /// The episode's state, updated with this decision.
    pub context: EpisodeContext,
    /// The decision.
    pub decision: Result<Decision, DecisionFault>,
    /// Time from the observations of the batch to its chosen actions.
    pub batch_time: Duration,
    /// Number of decisions in the batch.
    pub batch_size: usize,
}

impl DecisionBatcher {
    /// Starts the background task.
    pub fn start(decider: Arc<Decider>) -> DecisionBatcher {
        let (waiting, received) = mpsc::channel(WAITING_MAX);
        let active = Arc::new(AtomicUsize::new(0));
        tokio::spawn(decide_batches(decider, received, Arc::clone(&active)));
        DecisionBatcher { waiting, active }
    }

    /// Counts one more running episode: a batch waits for its share of them.
    pub fn activate(&self) -> Active {
        self.active.fetch_add(1, Ordering::AcqRel);
        Active(Arc::clone(&self.active))
    }

    /// Waits for a decision; `None` if the background task has ended or the decision panicked.
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
        // The batch grows while it waits for its turn.
        let Ok(turn) = Arc::clone(&calls).acquire_owned().await else { return };
        let Some(first) = received.recv().await else { return };
        let batch = gather(first, &mut received, &active, parallel).await;
        let (decider, runtime) = (Arc::clone(&decider), Handle::current());
        // A policy uses all cores for tens of milliseconds, so it must not block a thread that
        // other episodes need for their steps. A panic is reported by the panic hook; the episodes
        // of the batch then get no answer.
        tokio::task::spawn_blocking(move || {
            runtime.block_on(decide(&decider, batch));
            drop(turn);
        });
    }
}

/// Collects the episodes that are ready, and those that become ready soon, up to a share of all
/// running episodes.
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

/// Number of episodes per batch for this number of running episodes.
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
        // The episode may have been dropped in the meantime.
        let _ = one.answer.send(answer);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parallel_batches_share_the_episodes_and_small_batches_are_avoided() {
        let shares = |parallel: usize| [1, 2, 5, 6, 8, 16].map(|active| share(active, parallel));
        assert_eq!(shares(1), [1, 2, 5, 6, 8, 16]);
        assert_eq!(shares(2), [1, 2, 5, 3, 4, 8]);
        assert_eq!(shares(16), [1, 2, 5, 3, 4, 4]);
    }
}
