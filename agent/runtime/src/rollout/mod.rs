//! Rollouts: many episodes at once in lockstep, one pass of the network per control step for all of them.
//!
//! Arms may share a batch, for what a request gets from the policy does not depend on the requests beside it. An episode
//! that breaks is dropped alone, noted as a fault, and run again on another session; only an episode that ran to its end
//! is recorded.

mod attempt;
mod crew;
mod journal;
mod queue;

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result};
use protocol::{Reset, Transition, VerifierUpdate};
use tokio::sync::watch;
use tokio::task::{JoinSet, block_in_place};

pub use attempt::{Keep, Scene, Seat, candidate_action, score};
pub use crew::Crew;
pub use journal::Journal;
pub use queue::{ATTEMPTS_MAX, Job, Queue};

use attempt::Attempt;

use vla::Vla;

use decision::{Proposal, ProposalRequest};
use store::record::EpisodeIdentity;
use crate::stop::Stop;
use verifier::Verifier;
use crate::wire::EnvironmentFault;

/// Everything that a rollout uses.
pub struct Rollout<'a> {
    /// Proposes.
    pub policy: &'a Policy,
    /// Scores, when there is one; followed between episodes.
    pub verifier: Option<Arc<Verifier>>,
    /// Newer verifiers.
    pub updates: Option<watch::Receiver<Option<Arc<VerifierUpdate>>>>,
    /// Opens sessions.
    pub crew: Crew<'a>,
    /// What is to be run.
    pub queue: Queue,
    /// Where it goes.
    pub journal: Journal,
    /// Episodes at once.
    pub sessions: usize,
    /// What records hold beside the necessary.
    pub keep: Keep,
    /// Asked between episodes.
    pub stop: watch::Receiver<Stop>,
}

/// A step as it comes back from a server.
type Stepped = (Attempt, Result<Transition, EnvironmentFault>, f32);

impl Rollout<'_> {
    /// Runs the queue to its end, or until it is stopped. Afterwards queue and journal tell what came of it.
    pub async fn run(&mut self) -> Result<()> {
        let mut stop = self.stop.clone();
        tokio::select! {
            result = self.work() => result,
            // An error says that nobody can stop it any more, so it is no reason to stop.
            Ok(_) = stop.wait_for(|stop| *stop == Stop::Now) => Ok(()),
        }
    }

    async fn work(&mut self) -> Result<()> {
        let mut attempts = Vec::new();
        loop {
            self.fill(&mut attempts).await?;
            if attempts.is_empty() {
                // Resets may all have broken; what is to be run again waits in the queue.
                if self.queue.is_empty() || *self.stop.borrow() != Stop::No {
                    return Ok(());
                }
                continue;
            }
            let begun = Instant::now();
            let proposals = self.propose(&attempts)?;
            let logits = self.score(&mut attempts, &proposals);
            let actions = self.choose(&mut attempts, proposals, logits);
            let decision_ms = milliseconds_since(begun);
            attempts = self.step(attempts, actions, decision_ms).await?;
        }
    }

    /// Begins planned episodes on the free sessions, all resets at once.
    async fn fill(&mut self, attempts: &mut Vec<Attempt>) -> Result<()> {
        self.follow_verifier();
        let mut resets = JoinSet::new();
        while attempts.len() + resets.len() < self.sessions && *self.stop.borrow() == Stop::No {
            let Some(job) = self.queue.take() else { break };
            let is_alone = attempts.is_empty() && resets.is_empty();
            let Some((seat, environment)) = self.crew.seat(&job, is_alone).await? else {
                self.queue.put_back(job);
                break;
            };
            let reset = reset(&job.identity);
            resets.spawn(async move { (job, seat, environment.reset(reset).await) });
        }
        while let Some(joined) = resets.join_next().await {
            let (job, seat, result) = joined.context("a reset panicked")?;
            match result {
                Ok(episode) => {
                    let verifier = self.verifier.clone();
                    attempts.push(Attempt::new(job, seat, episode, verifier, self.keep)?);
                }
                Err(fault) => self.broke(job, &seat, &fault)?,
            }
        }
        Ok(())
    }

    fn propose(&self, attempts: &[Attempt]) -> Result<Vec<Proposal>> {
        let requests: Vec<ProposalRequest<'_>> = attempts.iter().map(Attempt::request).collect();
        // The network computes on all cores; the runtime's other tasks go on meanwhile.
        block_in_place(|| self.policy.propose(&requests))
    }

    fn score(&self, attempts: &mut [Attempt], proposals: &[Proposal]) -> Vec<Option<Vec<f32>>> {
        let decisions = attempts.iter_mut().zip(proposals);
        decisions.map(|(attempt, proposal)| attempt.score(proposal, self.policy)).collect()
    }

    fn choose(
        &self,
        attempts: &mut [Attempt],
        proposals: Vec<Proposal>,
        logits: Vec<Option<Vec<f32>>>,
    ) -> Vec<[f32; 7]> {
        let scale = self.policy.action_scale();
        let decisions = attempts.iter_mut().zip(proposals).zip(logits);
        let choose =
            |((attempt, proposal), logits): ((&mut Attempt, Proposal), Option<Vec<f32>>)| {
                attempt.choose(proposal, logits, &scale, self.keep)
            };
        decisions.map(choose).collect()
    }

    /// Steps all episodes at once; gives back those that go on.
    async fn step(
        &mut self,
        attempts: Vec<Attempt>,
        actions: Vec<[f32; 7]>,
        decision_ms: f32,
    ) -> Result<Vec<Attempt>> {
        let mut steps: JoinSet<Stepped> = JoinSet::new();
        for (mut attempt, action) in attempts.into_iter().zip(actions) {
            steps.spawn(async move {
                let begun = Instant::now();
                let result = attempt.episode.step(action).await;
                (attempt, result, milliseconds_since(begun))
            });
        }
        self.journal.progress.stepped(steps.len());
        let mut going_on = Vec::new();
        while let Some(joined) = steps.join_next().await {
            let (mut attempt, result, step_ms) = joined.context("a step panicked")?;
            match result {
                Ok(transition) if attempt.observe(&transition, decision_ms, step_ms)? => {
                    self.finish(attempt).await?;
                }
                Ok(_) => going_on.push(attempt),
                Err(fault) => self.broke(attempt.job, &attempt.seat, &fault)?,
            }
        }
        Ok(going_on)
    }

    async fn finish(&mut self, attempt: Attempt) -> Result<()> {
        let finished = attempt.finish(self.policy.digest())?;
        self.journal.record(&finished.record, finished.video.as_deref()).await?;
        self.crew.free(finished.seat, finished.episode.finish());
        Ok(())
    }

    fn broke(&mut self, job: Job, seat: &Seat, fault: &EnvironmentFault) -> Result<()> {
        self.crew.lost(seat, fault);
        self.journal.fault(&job, &seat.server, fault)?;
        self.queue.broke(job);
        Ok(())
    }

    /// Takes up a newer verifier, if there is one; episodes that run keep theirs.
    fn follow_verifier(&mut self) {
        let Some(updates) = &mut self.updates else { return };
        // An error says that no more can come.
        if !updates.has_changed().unwrap_or(false) {
            return;
        }
        let Some(update) = updates.borrow_and_update().clone() else { return };
        match Verifier::from_bytes(&update.weights, self.policy.digest()) {
            Ok(verifier) => {
                let digest = verifier.digest().get(..12).unwrap_or_default();
                self.journal.progress.say(&format!("verifier {} is now {digest}", update.name));
                self.verifier = Some(Arc::new(verifier));
            }
            Err(error) => tracing::warn!("the verifier {} is ignored: {error:#}", update.name),
        }
    }
}

fn reset(identity: &EpisodeIdentity) -> Reset {
    Reset {
        task: identity.task.clone(),
        variant: identity.variant.clone(),
        layout: identity.layout,
        seed: identity.seed,
    }
}

fn milliseconds_since(begun: Instant) -> f32 {
    begun.elapsed().as_secs_f32() * 1000.0
}
