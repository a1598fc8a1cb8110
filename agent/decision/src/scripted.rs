//! Scripted policies and scorers for tests that use a [`Decider`](crate::Decider).

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use anyhow::{Result, anyhow, bail};
use async_trait::async_trait;

use crate::{
    ActionChunk, ActionSpace, Candidate, Malformed, Parsed, Policy, PolicyInfo, Proposal,
    ProposalRequest, Reasoning, Scorer, ScoringRequest,
};

/// The scripted answer to one request.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// Candidates with these x motions. The list repeats if more candidates are requested; `None`
    /// makes a malformed candidate.
    Motions(Vec<Option<f32>>),
    /// The request fails, and with it every batch that contains it.
    Fails(String),
}

/// Answers a request by the script for its instruction; any other instruction gets one motion.
pub struct ScriptedPolicy {
    info: PolicyInfo,
    answers: Mutex<Vec<(String, VecDeque<Answer>)>>,
    /// Sizes of the requested batches.
    batches: Mutex<Vec<usize>>,
}

impl ScriptedPolicy {
    /// A policy with 7 action dimensions and without images.
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

    /// The answers to consecutive requests with this instruction; the last one repeats.
    pub fn with(self, instruction: &str, answers: impl IntoIterator<Item = Answer>) -> Self {
        let answers = answers.into_iter().collect();
        self.answers
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .push((instruction.to_owned(), answers));
        self
    }

    /// Sizes of the batches requested so far.
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
            // Only a single request uses up its answer: after a failed batch every request is
            // repeated alone.
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

/// A candidate that moves by `x`; malformed for `None`.
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

/// Scores a candidate by its x motion; may fail for one instruction.
pub struct ScriptedScorer {
    digest: String,
    sign: f32,
    failing: Option<String>,
}

impl ScriptedScorer {
    /// Larger motions get higher scores, or lower ones with `sign` -1.
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
                return Err(anyhow!("the scripted scorer fails"));
            }
            let motion = |candidate: &Candidate| {
                candidate.action().map_or(f32::NAN, |action| action.actions.first()[0])
            };
            Ok(request.candidates.iter().map(|one| self.sign * motion(one)).collect())
        };
        requests.iter().map(score).collect()
    }
}
