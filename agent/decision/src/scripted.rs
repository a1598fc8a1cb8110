//! Policies and scorers that follow a script, for tests of whatever uses a [`Decider`](crate::Decider).

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use anyhow::{Result, anyhow, bail};
use async_trait::async_trait;

use crate::{
    ActionChunk, ActionSpace, Candidate, Malformed, Parsed, Policy, PolicyInfo, Proposal,
    ProposalRequest, Reasoning, Scorer, ScoringRequest,
};

/// What a scripted policy answers to one request.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// Candidates with these x motions, as many as are asked for from the list's beginning, over and over; a motion that
    /// is none makes a malformed candidate.
    Motions(Vec<Option<f32>>),
    /// The request fails, and with it every batch that it is in.
    Fails(String),
}

/// Answers every request whose instruction is known with its own script, others with one motion.
pub struct ScriptedPolicy {
    info: PolicyInfo,
    answers: Mutex<Vec<(String, VecDeque<Answer>)>>,
    /// Sizes of the batches that it was asked for.
    batches: Mutex<Vec<usize>>,
}

impl ScriptedPolicy {
    /// A policy of 7 numbers with images of no pixels.
    pub fn new() -> ScriptedPolicy {
        ScriptedPolicy {
            info: PolicyInfo {
                digest: "scripted".to_owned(),
                image_size: (0, 0),
                action_space: ActionSpace { scale: vec![1.0; 7], gripper: Some(6) },
                hidden_size: Some(1),
                parallel_calls: 1,
            },
            answers: Mutex::default(),
            batches: Mutex::default(),
        }
    }

    /// The answers to requests with this instruction, one for each; the last one stays.
    pub fn with(self, instruction: &str, answers: impl IntoIterator<Item = Answer>) -> Self {
        let answers = answers.into_iter().collect();
        self.answers
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push((instruction.to_owned(), answers));
        self
    }

    /// Sizes of the batches that it was asked for so far.
    pub fn batches(&self) -> Vec<usize> {
        self.batches.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn answer(&self, instruction: &str, is_consumed: bool) -> Answer {
        let mut answers = self.answers.lock().unwrap_or_else(PoisonError::into_inner);
        let script = answers.iter_mut().find(|(known, _)| known == instruction);
        let Some((_, script)) = script else { return Answer::Motions(vec![Some(0.0)]) };
        let next = script.front().cloned().unwrap_or(Answer::Motions(vec![Some(0.0)]));
        if is_consumed && script.len() > 1 {
            script.pop_front();
        }
        next
    }
}

impl Default for ScriptedPolicy {
    fn default() -> Self {
        ScriptedPolicy::new()
    }
}

#[async_trait]
impl Policy for ScriptedPolicy {
    fn info(&self) -> &PolicyInfo {
        &self.info
    }

    async fn propose(&self, requests: &[ProposalRequest<'_>]) -> Result<Vec<Proposal>> {
        self.batches.lock().unwrap_or_else(PoisonError::into_inner).push(requests.len());
        let failing = requests.iter().find_map(|one| match self.answer(one.instruction, false) {
            Answer::Fails(reason) => Some((one.instruction, reason)),
            Answer::Motions(_) => None,
        });
        if let Some((instruction, reason)) = failing {
            // Alone it uses up its answer; in a batch everybody is asked again.
            if requests.len() == 1 {
                self.answer(instruction, true);
            }
            bail!("{reason}");
        }
        let proposal = |request: &ProposalRequest<'_>| {
            let Answer::Motions(motions) = self.answer(request.instruction, true) else {
                bail!("the script of {} changed", request.instruction);
            };
            let motions = motions.iter().cycle().take(request.candidates);
            let candidates = motions.map(|motion| candidate(*motion)).collect::<Result<_>>()?;
            Ok(Proposal { candidates })
        };
        requests.iter().map(proposal).collect()
    }
}

/// A candidate that moves by `x`; a malformed one for none.
pub fn candidate(x: Option<f32>) -> Result<Candidate> {
    let parsed = match x {
        Some(x) => Ok(Parsed {
            reasoning: Reasoning::default(),
            action_tokens: Vec::new(),
            actions: ActionChunk::single(vec![x, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])?,
        }),
        None => Err(Malformed::new("expected an action, got none")),
    };
    Ok(Candidate {
        tokens: vec![1, 2],
        log_probability: -1.0,
        log_probabilities: vec![-0.5; 2],
        confidence: vec![0.0; 16],
        hidden: vec![x.unwrap_or_default()],
        parsed,
    })
}

/// Scores a candidate by its x motion, or fails for an instruction.
pub struct ScriptedScorer {
    digest: String,
    sign: f32,
    failing: Option<String>,
}

impl ScriptedScorer {
    /// The farther a candidate moves, the better; with `sign` -1 the other way round.
    pub fn new(digest: &str, sign: f32) -> ScriptedScorer {
        ScriptedScorer { digest: digest.to_owned(), sign, failing: None }
    }

    /// Fails in episodes with this instruction.
    pub fn failing_for(mut self, instruction: &str) -> ScriptedScorer {
        self.failing = Some(instruction.to_owned());
        self
    }
}

#[async_trait]
impl Scorer for ScriptedScorer {
    fn digest(&self) -> &str {
        &self.digest
    }

    async fn score(&self, requests: &[ScoringRequest<'_>]) -> Vec<Result<Vec<f32>>> {
        let score = |request: &ScoringRequest<'_>| {
            if self.failing.as_deref() == Some(request.instruction) {
                return Err(anyhow!("the judge is silent"));
            }
            let motion = |candidate: &Candidate| {
                candidate.action().map_or(f32::NAN, |action| action.actions.first()[0])
            };
            Ok(request.candidates.iter().map(|one| self.sign * motion(one)).collect())
        };
        requests.iter().map(score).collect()
    }
}
