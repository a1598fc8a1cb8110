//! The decisions of one control step for a batch of episodes: propose, score, choose.

use std::sync::Arc;

use thiserror::Error;

use crate::{
    ActionChunk, Alternatives, Candidate, EpisodeContext, Observation, Policy, Proposal,
    ProposalRequest, ReasoningFeatures, Scorer, ScoringRequest, TrackedObjects,
};

/// Makes decisions with one policy. It has no state: the state of an episode is its
/// [`EpisodeContext`].
pub struct Decider {
    policy: Arc<dyn Policy>,
}

/// An episode that waits for a decision.
pub struct DecisionRequest<'a> {
    /// The current observation.
    pub observation: &'a Observation,
    /// The episode's state. After a fault it must not be used again.
    pub context: &'a mut EpisodeContext,
}

/// The result of a decision.
#[derive(Debug, Clone, PartialEq)]
pub struct Decision {
    /// All sampled candidates.
    pub candidates: Vec<Candidate>,
    /// The scorer's logit of each candidate, if there is a scorer.
    pub logits: Option<Vec<f32>>,
    /// Index of the executed candidate; `None` if no candidate is well formed and the robot holds
    /// still.
    pub chosen: Option<usize>,
    /// The actions to execute in this and the following control steps.
    pub actions: ActionChunk,
}

/// Why there is no decision. This is a fault of the episode, never an outcome.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum DecisionFault {
    /// The policy failed for this request.
    #[error("policy: {reason}")]
    Policy {
        /// What was expected and what was received.
        reason: String,
    },
    /// The scorer failed.
    #[error("scorer: {reason}")]
    Scorer {
        /// What was expected and what was received.
        reason: String,
    },
}

impl DecisionFault {
    fn policy(error: &anyhow::Error) -> DecisionFault {
        DecisionFault::Policy { reason: format!("{error:#}") }
    }

    fn scorer(error: &anyhow::Error) -> DecisionFault {
        DecisionFault::Scorer { reason: format!("{error:#}") }
    }
}

type Scored = Result<(Proposal, Option<Vec<f32>>), DecisionFault>;

impl Decider {
    /// A decider that uses `policy`.
    pub fn new(policy: Arc<dyn Policy>) -> Decider {
        Decider { policy }
    }

    /// The policy of this decider.
    pub fn policy(&self) -> &Arc<dyn Policy> {
        &self.policy
    }

    /// Decides for all requests and returns the decisions in their order. A decision does not
    /// depend on the other requests of the batch.
    pub async fn decide(
        &self,
        mut requests: Vec<DecisionRequest<'_>>,
    ) -> Vec<Result<Decision, DecisionFault>> {
        let proposals = self.propose(&requests).await;
        let scored = self.score(&mut requests, proposals).await;
        requests
            .iter_mut()
            .zip(scored)
            .map(|(request, scored)| self.choose(request, scored?))
            .collect()
    }

    /// Proposes candidates for all requests in one batch. If the batch fails, proposes for each
    /// request alone, so that one failing request does not affect the others.
    async fn propose(
        &self,
        requests: &[DecisionRequest<'_>],
    ) -> Vec<Result<Proposal, DecisionFault>> {
        let asked: Vec<ProposalRequest<'_>> = requests.iter().map(proposal_request).collect();
        let together = self.proposals(&asked).await;
        match together {
            Ok(proposals) => proposals.into_iter().map(Ok).collect(),
            Err(error) if asked.len() == 1 => vec![Err(DecisionFault::policy(&error))],
            Err(_) => {
                let mut proposals = Vec::with_capacity(asked.len());
                for one in &asked {
                    let alone = self.proposals(std::slice::from_ref(one)).await;
                    let alone = alone.map(|mut proposals| proposals.remove(0));
                    proposals.push(alone.map_err(|error| DecisionFault::policy(&error)));
                }
                proposals
            }
        }
    }

    /// Checks that there is one proposal per request, each with the requested number of candidates.
    async fn proposals(&self, asked: &[ProposalRequest<'_>]) -> anyhow::Result<Vec<Proposal>> {
        let proposals = self.policy.propose(asked).await?;
        anyhow::ensure!(
            proposals.len() == asked.len(),
            "expected {} proposals, got {}",
            asked.len(),
            proposals.len()
        );
        for (proposal, request) in proposals.iter().zip(asked) {
            let (expected, got) = (request.candidates, proposal.candidates.len());
            anyhow::ensure!(got == expected, "expected {expected} candidates, got {got}");
        }
        Ok(proposals)
    }

    /// Scores every proposal of an episode that has a scorer. Requests with the same scorer are
    /// scored in one batch.
    async fn score(
        &self,
        requests: &mut [DecisionRequest<'_>],
        proposals: Vec<Result<Proposal, DecisionFault>>,
    ) -> Vec<Scored> {
        let tracked: Vec<TrackedObjects> = requests
            .iter_mut()
            .zip(&proposals)
            .map(|(request, proposal)| match proposal {
                Ok(proposal) => track(request.context, proposal),
                Err(_) => TrackedObjects::default(),
            })
            .collect();
        let mut logits: Vec<Option<Result<Vec<f32>, DecisionFault>>> =
            proposals.iter().map(|_| None).collect();
        for (scorer, members) in by_scorer(requests, &proposals) {
            let asked: Vec<ScoringRequest<'_>> = members
                .iter()
                .filter_map(|&index| {
                    let (request, proposal) = (&requests[index], proposals[index].as_ref().ok()?);
                    Some(ScoringRequest {
                        image: &request.observation.image,
                        state: &request.observation.state,
                        instruction: &request.context.instruction,
                        candidates: &proposal.candidates,
                        tracked: tracked[index],
                        action_space: &self.policy.info().action_space,
                    })
                })
                .collect();
            let scores = scorer.score(&asked).await;
            let missing = || Err(anyhow::anyhow!("expected {} results, got fewer", asked.len()));
            let mut scores = scores.into_iter();
            for (&index, asked) in members.iter().zip(&asked) {
                let scores = scores.next().unwrap_or_else(missing);
                let checked = scores.and_then(|scores| check(scores, asked.candidates));
                logits[index] = Some(checked.map_err(|error| DecisionFault::scorer(&error)));
            }
        }
        proposals
            .into_iter()
            .zip(logits)
            .map(|(proposal, logits)| Ok((proposal?, logits.transpose()?)))
            .collect()
    }

    fn choose(
        &self,
        request: &mut DecisionRequest<'_>,
        (proposal, logits): (Proposal, Option<Vec<f32>>),
    ) -> Result<Decision, DecisionFault> {
        let DecisionRequest { observation, context } = request;
        let space = &self.policy.info().action_space;
        let candidates: Vec<_> = proposal.candidates.iter().map(Candidate::action).collect();
        let chosen = context.setting.strategy.choose(&Alternatives {
            candidates: &candidates,
            logits: logits.as_deref(),
            expert_action: observation.expert_action.as_deref(),
            action_space: space,
        });
        let actions = match chosen.and_then(|index| candidates[index]) {
            Some(one) => one.actions.clone(),
            None => ActionChunk::single(context.hold_still().to_vec())
                .map_err(|error| DecisionFault::policy(&error))?,
        };
        context.note(actions.actions(), space);
        Ok(Decision { candidates: proposal.candidates, logits, chosen, actions })
    }
}

fn proposal_request<'a>(request: &'a DecisionRequest<'_>) -> ProposalRequest<'a> {
    let (observation, context) = (request.observation, &*request.context);
    ProposalRequest {
        image: &observation.image,
        state: &observation.state,
        instruction: &context.instruction,
        candidates: context.setting.candidates as usize,
        temperature: context.setting.temperature,
        seed: context.seed(),
        episode: Some(&context.episode),
    }
}

/// Updates the object tracker with the candidates' reasoning.
fn track(context: &mut EpisodeContext, proposal: &Proposal) -> TrackedObjects {
    let parsed = proposal.candidates.iter().filter_map(|candidate| candidate.parsed.as_ref().ok());
    let said: Vec<ReasoningFeatures> =
        parsed.filter_map(|parsed| ReasoningFeatures::of(&parsed.reasoning)).collect();
    context.tracker.note(&said)
}

/// The scorers of the requests that have a proposal, each with the indices of its requests.
fn by_scorer(
    requests: &[DecisionRequest<'_>],
    proposals: &[Result<Proposal, DecisionFault>],
) -> Vec<(Arc<dyn Scorer>, Vec<usize>)> {
    let mut groups: Vec<(Arc<dyn Scorer>, Vec<usize>)> = Vec::new();
    for (index, request) in
        requests.iter().enumerate().filter(|(index, _)| proposals[*index].is_ok())
    {
        let Some(scorer) = &request.context.scorer else { continue };
        match groups.iter_mut().find(|(known, _)| Arc::ptr_eq(known, scorer)) {
            Some((_, members)) => members.push(index),
            None => groups.push((Arc::clone(scorer), vec![index])),
        }
    }
    groups
}

/// Checks that every well-formed candidate has one finite logit.
fn check(logits: Vec<f32>, candidates: &[Candidate]) -> anyhow::Result<Vec<f32>> {
    let (expected, got) = (candidates.len(), logits.len());
    anyhow::ensure!(got == expected, "expected {expected} scores, got {got}");
    let scored = candidates.iter().zip(&logits).enumerate();
    for (index, (_, logit)) in scored.filter(|(_, (candidate, _))| candidate.parsed.is_ok()) {
        anyhow::ensure!(
            logit.is_finite(),
            "expected a finite score of candidate {index}, got {logit}"
        );
    }
    Ok(logits)
}

#[cfg(test)]
mod tests;
