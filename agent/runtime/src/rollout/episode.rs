//! One attempt at an episode, from the reset to its record. A failed attempt is a fault and has no
//! record.

use std::sync::Arc;
use std::time::Instant;

use batching::{Answer, DecisionBatcher};
use decision::{
    Candidate, Decision, EpisodeContext, EpisodeName, EpisodeToken, Observation, Parsed, Policy,
    Scorer, probability,
};
use protocol::{Reset, TaskDescription};
use store::queue::Lease;
use store::record::{
    CandidateRecord, DecisionRecord, EpisodeRecord, RECORD_VERSION, Reading, StepRecord, Versions,
    hidden_to_bytes,
};

use super::RecordOptions;
use super::first_decisions::FirstDecisions;
use crate::fault::AttemptFault;
use crate::session::{Environment, Episode, Session, SessionInfo, SessionPool};
use crate::sinks::{Event, Sinks};

/// Everything that one attempt uses.
pub struct EpisodeRun<'a, P> {
    pub lease: &'a Lease,
    pub options: RecordOptions,
    pub versions: &'a Versions,
    pub policy: &'a dyn Policy,
    pub first_decisions: &'a FirstDecisions,
    /// The scorer of the whole episode, even if a new verifier is published meanwhile.
    pub scorer: Option<Arc<dyn Scorer>>,
    pub batcher: &'a DecisionBatcher,
    pub sinks: &'a Sinks,
    pub pool: &'a P,
}

/// The state of a running episode.
struct Progress {
    context: EpisodeContext,
    steps: Vec<StepRecord>,
    is_over: bool,
}

impl<P: SessionPool> EpisodeRun<'_, P> {
    /// Runs the episode on a session; returns its record and the session.
    pub async fn run(
        &self,
        session: Session<P::Environment>,
    ) -> Result<(EpisodeRecord, P::Environment), AttemptFault> {
        let Session { info, environment } = session;
        let identity = &self.lease.job.identity;
        let reset = Reset {
            task: identity.task.clone(),
            variant: identity.variant.clone(),
            layout: identity.layout,
            seed: identity.seed,
        };
        let mut episode = match environment.reset(reset).await {
            Ok(episode) => episode,
            Err(fault) => {
                self.pool.lost(&info, &fault);
                return Err(fault.into());
            }
        };
        let started = Instant::now();
        match self.play(&mut episode, &info).await {
            Ok(progress) => {
                let record = self.record(progress, &info, started);
                Ok((record, episode.finish()))
            }
            Err(AttemptFault::Environment(fault)) => {
                self.pool.lost(&info, &fault);
                Err(fault.into())
            }
            // The session is still usable.
            Err(fault) => {
                self.pool.release(Session { info, environment: episode.finish() });
                Err(fault)
            }
        }
    }

    async fn play(
        &self,
        episode: &mut <P::Environment as Environment>::Episode,
        info: &SessionInfo,
    ) -> Result<Progress, AttemptFault> {
        let observation = episode.observation();
        self.emit_frame(observation, true).await?;
        let identity = &self.lease.job.identity;
        let mut context = EpisodeContext::new(
            self.lease.job.setting,
            identity.sampling_seed,
            observation.instruction.clone(),
            self.scorer.clone(),
            &info.task.action,
        );
        let task = identity.task_id().to_string();
        context.episode = EpisodeToken::new(EpisodeName { task, episode: identity.episode });
        let mut progress = Progress { context, steps: Vec::new(), is_over: false };
        while !progress.is_over {
            progress = self.step(episode, info, progress).await?;
        }
        Ok(progress)
    }

    /// One decision and the control steps that execute it.
    async fn step(
        &self,
        episode: &mut <P::Environment as Environment>::Episode,
        info: &SessionInfo,
        progress: Progress,
    ) -> Result<Progress, AttemptFault> {
        let Progress { context, mut steps, mut is_over } = progress;
        let answer = self.batcher.decide(episode.observation().clone(), context).await;
        let Answer { context, decision, batch_time, batch_size } =
            answer.ok_or(AttemptFault::Stopped)?;
        let Decision { candidates, logits, chosen, actions } = decision?;
        self.first_decisions.note(&candidates, self.policy)?;
        let records = candidates.into_iter().enumerate().map(|(index, candidate)| {
            let keep_hidden = self.options.all_hidden || chosen == Some(index);
            let logit = logits.as_ref().map(|logits| logits[index]);
            candidate_record(candidate, logit, keep_hidden, self.options.readings)
        });
        let mut decision = Some(DecisionRecord {
            candidates: records.collect(),
            chosen: chosen.map(|index| index as u32),
            batch_ms: batch_time.as_secs_f32() * 1e3,
            batch_size: batch_size as u32,
        });
        for action in actions.into_actions() {
            let state = episode.observation().state.clone();
            let asked = Instant::now();
            let transition = episode.step(&action).await?;
            steps.push(StepRecord {
                state,
                decision: decision.take(),
                action,
                statistics: transition.statistics,
                step_ms: asked.elapsed().as_secs_f32() * 1e3,
                simulator_ms: episode.simulator_time().as_secs_f32() * 1e3,
            });
            self.emit_frame(episode.observation(), false).await?;
            is_over = transition.terminated || transition.truncated;
            if is_over {
                break;
            }
            check_length(&info.task, steps.len())?;
        }
        Ok(Progress { context, steps, is_over })
    }

    /// Frames are sent only if videos are requested.
    async fn emit_frame(&self, seen: &Observation, is_first: bool) -> Result<(), AttemptFault> {
        let id = self.lease.job.identity.id();
        let image = self.options.video.then(|| seen.image.clone());
        let event =
            if is_first { Event::Started { id, image } } else { Event::Stepped { id, image } };
        self.sinks.emit(event).await.map_err(|_| AttemptFault::Stopped)
    }

    fn record(&self, progress: Progress, info: &SessionInfo, started: Instant) -> EpisodeRecord {
        let Progress { context, steps, .. } = progress;
        EpisodeRecord {
            version: RECORD_VERSION,
            identity: self.lease.job.identity.clone(),
            versions: Versions {
                simulator: info.simulator.clone(),
                policy: self.policy.info().digest.clone(),
                verifier: self.scorer.as_ref().map(|scorer| scorer.digest().to_owned()),
                ..self.versions.clone()
            },
            instruction: context.instruction,
            steps_max: info.task.steps_max,
            statistics: steps.last().map(|step| step.statistics).unwrap_or_default(),
            steps,
            wall_secs: started.elapsed().as_secs_f32(),
        }
    }
}

/// Checks a server against its own description: an episode must end at the task's horizon.
fn check_length(task: &TaskDescription, steps: usize) -> Result<(), AttemptFault> {
    let expected = task.steps_max as usize;
    if steps < expected {
        return Ok(());
    }
    Err(AttemptFault::Environment(crate::fault::EnvironmentFault::wire(format!(
        "expected task {} to end after {expected} steps, the horizon in its description, but it did not",
        task.task
    ))))
}

fn candidate_record(
    candidate: Candidate,
    logit: Option<f32>,
    keep_hidden: bool,
    keep_reading: bool,
) -> CandidateRecord {
    let is_well_formed = candidate.parsed.is_ok();
    let (actions, unread, malformed, reading) = match candidate.parsed {
        Ok(Parsed { reasoning, action_tokens, actions }) => {
            let unread = reasoning.unread.iter().map(ToString::to_string).collect();
            let confidence = candidate.confidence;
            let reading = keep_reading.then_some(Reading { reasoning, action_tokens, confidence });
            (Some(actions), unread, None, reading)
        }
        Err(malformed) => (None, Vec::new(), Some(malformed.to_string()), None),
    };
    CandidateRecord {
        actions,
        malformed,
        unread,
        reading,
        // A malformed candidate has no action, so it has no success probability.
        score: logit.filter(|_| is_well_formed).map(probability),
        log_probability: candidate.log_probability,
        log_probabilities: candidate.log_probabilities,
        hidden: keep_hidden.then(|| hidden_to_bytes(&candidate.hidden)),
        tokens: candidate.tokens,
    }
}
