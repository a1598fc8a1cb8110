//! One attempt at an episode, from its first observation to its record.

use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use protocol::{Observation, Transition};

use super::queue::Job;
use decision::{Candidate, Proposal, ProposalRequest};
use vla::Vla;
use store::record::{CandidateRecord, EpisodeRecord, RECORD_VERSION, StepRecord, Versions, hidden_to_bytes};
use decision::CandidateAction;
use crate::strategy::Decision;
use decision::step_seed;
use verifier::{Memory, Sibling, Siblings, Verifier, Words};
use decision::probability;
use store::video::Video;
use crate::wire::Episode;

/// An episode in progress. It ends as a record or, when something breaks, as nothing.
pub struct Attempt {
    /// What is being run.
    pub job: Job,
    /// Where.
    pub seat: Seat,
    /// The simulator's side of it.
    pub episode: Episode,
    /// The same from the first step to the last, whatever is published meanwhile.
    verifier: Option<Arc<Verifier>>,
    scene: Scene,
    steps: Vec<StepRecord>,
    /// The last gripper command: what holding still means for it. Episodes begin with an open gripper.
    gripper: f32,
    video: Option<Video>,
    started: Instant,
}

/// What the verifier knows of an episode beside the candidates.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    /// What the robot was told.
    pub instruction: String,
    /// Where the gripper is: x and y in the base frame, metres.
    pub gripper: [f32; 2],
    /// What was said so far.
    pub memory: Memory,
}

/// A session on a server.
#[derive(Debug, Clone)]
pub struct Seat {
    /// The server's id.
    pub server: String,
    /// The server's simulator and its version.
    pub simulator: String,
    /// Whether observations carry the expert's action.
    pub has_expert: bool,
}

/// What a candidate's record keeps.
#[derive(Debug, Clone, Copy)]
pub struct Keep {
    /// The hidden states of all candidates instead of the chosen one's.
    pub all_hidden: bool,
    /// A video of every episode.
    pub video: bool,
}

impl Attempt {
    /// Begins with an episode that has just been reset.
    pub fn new(
        job: Job,
        seat: Seat,
        episode: Episode,
        verifier: Option<Arc<Verifier>>,
        keep: Keep,
    ) -> Result<Attempt> {
        let observation = episode.observation();
        let image = &observation.image;
        let mut video = keep.video.then(|| Video::new(image.height, image.width)).transpose()?;
        if let Some(video) = &mut video {
            video.push(&image.pixels)?;
        }
        let instruction = observation.instruction.clone();
        let scene = Scene { instruction, ..Scene::default() };
        let (steps, started) = (Vec::new(), Instant::now());
        Ok(Attempt { job, seat, episode, verifier, scene, steps, gripper: 1.0, video, started })
    }

    /// What is asked of the policy at this step.
    pub fn request(&self) -> ProposalRequest<'_> {
        let Observation { image, instruction, .. } = self.episode.observation();
        ProposalRequest {
            image,
            instruction,
            candidates: self.job.setting.candidates as usize,
            temperature: self.job.setting.temperature,
            seed: step_seed(self.job.identity.sampling_seed, self.steps.len() as u32),
        }
    }

    /// The verifier's logits of the candidates; once per step, for what they say is remembered.
    pub fn score(&mut self, proposal: &Proposal, policy: &Policy) -> Option<Vec<f32>> {
        let [x, y, ..] = self.episode.state();
        self.scene.gripper = [x, y];
        let verifier = self.verifier.as_ref()?;
        Some(score(verifier, proposal, policy, &mut self.scene))
    }

    /// Chooses a candidate, notes the step, and says what to do.
    pub fn choose(
        &mut self,
        proposal: Proposal,
        logits: Option<Vec<f32>>,
        action_scale: &[f32; 7],
        keep: Keep,
    ) -> [f32; 7] {
        let candidates: Vec<_> = proposal.candidates.iter().map(candidate_action).collect();
        let expert_action = self.episode.expert_action();
        let decision = Decision {
            candidates: &candidates,
            logits: logits.as_deref(),
            expert_action: expert_action.as_ref(),
            action_scale,
        };
        let chosen = self.job.setting.strategy.choose(&decision);
        let hold_still = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, self.gripper];
        let action =
            chosen.and_then(|index| candidates[index]).map_or(hold_still, |one| one.action);
        self.gripper = action[6];
        let records = proposal.candidates.into_iter().enumerate().map(|(index, candidate)| {
            let keep_hidden = keep.all_hidden || chosen == Some(index);
            candidate_record(candidate, logits.as_ref().map(|logits| logits[index]), keep_hidden)
        });
        self.steps.push(StepRecord {
            state: self.episode.state(),
            candidates: records.collect(),
            chosen: chosen.map(|index| index as u32),
            statistics: protocol::Statistics::default(),
            decision_ms: 0.0,
            step_ms: 0.0,
            simulator_ms: None,
        });
        action
    }

    /// Completes the step's note with what came of it. True when the episode is over.
    pub fn observe(
        &mut self,
        transition: &Transition,
        decision_ms: f32,
        step_ms: f32,
    ) -> Result<bool> {
        if let Some(video) = &mut self.video {
            video.push(&transition.observation.image.pixels)?;
        }
        if let Some(step) = self.steps.last_mut() {
            step.statistics = transition.statistics;
            step.decision_ms = decision_ms;
            step.step_ms = step_ms;
            step.simulator_ms = Some(self.episode.simulator_time().as_secs_f32() * 1e3);
        }
        Ok(transition.terminated || transition.truncated)
    }

    /// The record of an episode that is over, its video, and what it ran on.
    pub fn finish(self, policy: &str) -> Result<Finished> {
        let last = self.steps.last();
        let statistics = last.map(|step| step.statistics).unwrap_or_default();
        let record = EpisodeRecord {
            version: RECORD_VERSION,
            identity: self.job.identity,
            versions: Versions {
                rever: env!("CARGO_PKG_VERSION").to_owned(),
                protocol: protocol::PROTOCOL_VERSION,
                simulator: self.seat.simulator.clone(),
                policy: policy.to_owned(),
                verifier: self.verifier.map(|verifier| verifier.digest().to_owned()),
            },
            instruction: self.scene.instruction,
            statistics,
            steps: self.steps,
            wall_secs: self.started.elapsed().as_secs_f32(),
        };
        let video = self.video.map(Video::finish).transpose()?;
        Ok(Finished { record, video, seat: self.seat, episode: self.episode })
    }
}

/// What is left of an attempt that succeeded or failed, but did not break.
pub struct Finished {
    /// What happened.
    pub record: EpisodeRecord,
    /// An MP4 file.
    pub video: Option<Vec<u8>>,
    /// Where it ran: free again.
    pub seat: Seat,
    /// To be finished.
    pub episode: Episode,
}

/// The verifier's logits of a proposal's candidates; the scene remembers what they say.
pub fn score(
    verifier: &Verifier,
    proposal: &Proposal,
    policy: &Policy,
    scene: &mut Scene,
) -> Vec<f32> {
    let hidden: Vec<&[f32]> = proposal.candidates.iter().map(|one| &*one.hidden).collect();
    let sibling = |candidate: &Candidate| {
        let action = candidate_action(candidate)?;
        let Candidate { tokens, log_probabilities, .. } = candidate;
        let words = candidate.parsed.as_ref().ok().and_then(|parsed| Words::of(&parsed.reasoning));
        let confidence = policy.confidence(tokens, log_probabilities);
        Some(Sibling { action, confidence, words })
    };
    let candidates: Vec<Option<Sibling>> = proposal.candidates.iter().map(sibling).collect();
    let words: Vec<Words> = candidates.iter().flatten().filter_map(|one| one.words).collect();
    verifier.logits(&Siblings {
        hidden: &hidden,
        candidates: &candidates,
        action_scale: &policy.action_scale(),
        instruction: &scene.instruction,
        gripper: scene.gripper,
        outlook: scene.memory.note(&words),
    })
}

/// What a candidate would do; none when it is malformed.
pub fn candidate_action(candidate: &Candidate) -> Option<CandidateAction> {
    let parsed = candidate.parsed.as_ref().ok()?;
    Some(CandidateAction { tokens: parsed.action_tokens, action: parsed.action })
}

fn candidate_record(
    candidate: Candidate,
    logit: Option<f32>,
    keep_hidden: bool,
) -> CandidateRecord {
    let is_well_formed = candidate.parsed.is_ok();
    CandidateRecord {
        action: candidate.parsed.as_ref().ok().map(|parsed| parsed.action),
        malformed: candidate.parsed.err().map(|malformed| malformed.to_string()),
        // A malformed candidate has no action whose success could be likely.
        score: logit.filter(|_| is_well_formed).map(probability),
        log_probability: candidate.log_probability,
        log_probabilities: candidate.log_probabilities,
        hidden: keep_hidden.then(|| hidden_to_bytes(&candidate.hidden)),
        tokens: candidate.tokens,
    }
}
