//! A checkpoint as the backbone of a verifier, for policies that expose no hidden states.
//!
//! The backbone sees what the policy saw, the image and the instruction. Once per decision it
//! writes its own reasoning, greedily, and then reads the first action of each candidate as if it
//! had chosen it. What a verifier needs of a candidate (hidden state, log-probabilities, the
//! objects' positions) is then the backbone's; the actions remain the policy's.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, Result, ensure};
use async_trait::async_trait;
use decision::{
    Candidate, Parsed, Policy, PolicyInfo, Proposal, ProposalRequest, Setting, Strategy, TAGS,
    fit_image,
};
use protocol::message::Image;
use sha2::{Digest, Sha256};

use crate::Vla;
use crate::checkpoint::config::ACTION_LENGTH;

/// A policy whose candidates are read by a backbone.
pub struct BackbonePolicy {
    policy: Arc<dyn Policy>,
    backbone: Arc<Vla>,
    info: PolicyInfo,
    is_unread_said: AtomicBool,
}

impl BackbonePolicy {
    /// Refuses a policy whose actions the backbone cannot read.
    pub fn new(policy: Arc<dyn Policy>, backbone: Arc<Vla>) -> Result<BackbonePolicy> {
        let (of_policy, own) = (policy.info(), backbone.info());
        let (expected, got) = (&own.action_space, &of_policy.action_space);
        ensure!(
            (got.length(), got.gripper) == (expected.length(), expected.gripper),
            "backbone: expected a policy whose actions have {} numbers and the gripper last, got {} numbers",
            expected.length(),
            got.length()
        );
        ensure!(
            of_policy.image_size.0 * of_policy.image_size.1 > 0,
            "backbone: expected a policy that sees images, got one without"
        );
        let digest = read_digest(&of_policy.digest, &own.digest);
        let info = PolicyInfo {
            digest,
            hidden_size: own.hidden_size,
            parallel_calls: own.parallel_calls,
            ..of_policy.clone()
        };
        Ok(BackbonePolicy { policy, backbone, info, is_unread_said: AtomicBool::new(false) })
    }

    /// The candidates with what the backbone reads of them. `images` have the backbone's size. Blocks
    /// the calling thread.
    fn read(
        &self,
        requests: &[ProposalRequest<'_>],
        images: &[Image],
        proposals: Vec<Proposal>,
    ) -> Result<Vec<Proposal>> {
        let actions = proposals.iter().map(|proposal| self.actions(proposal));
        let actions: Vec<Vec<[u32; ACTION_LENGTH]>> = actions.collect::<Result<_>>()?;
        let mut readings = Vec::with_capacity(requests.len());
        for ((request, image), actions) in requests.iter().zip(images).zip(&actions) {
            let reading = ProposalRequest {
                image,
                candidates: actions.len(),
                temperature: 0.0,
                episode: None,
                ..*request
            };
            readings.push((reading, actions.as_slice()));
        }
        // A decision without any well-formed candidate has nothing to read.
        let (asked, given): (Vec<_>, Vec<_>) =
            readings.iter().filter(|(_, actions)| !actions.is_empty()).copied().unzip();
        let mut read = self.backbone.complete(&asked, &given)?.into_iter();
        let with_readings = |(mut proposal, actions): (Proposal, &Vec<[u32; ACTION_LENGTH]>)| {
            let read = match actions.is_empty() {
                true => Vec::new(),
                false => read.next().context("expected a reading")?.candidates,
            };
            let well_formed = proposal.candidates.iter_mut().filter(|one| one.parsed.is_ok());
            for (candidate, reading) in well_formed.zip(read) {
                *candidate = self.merge(candidate, reading);
            }
            Ok(proposal)
        };
        proposals.into_iter().zip(&actions).map(with_readings).collect()
    }

    /// The backbone's tokens for the first action of every well-formed candidate.
    fn actions(&self, proposal: &Proposal) -> Result<Vec<[u32; ACTION_LENGTH]>> {
        let actions = proposal.candidates.iter().filter_map(Candidate::action);
        let encode = |action: &[f32]| -> Result<[u32; ACTION_LENGTH]> {
            let got = action.len();
            let action = action.first_chunk().filter(|_| got == ACTION_LENGTH);
            let action = action.with_context(|| {
                format!("backbone: expected actions of {ACTION_LENGTH} numbers, got {got}")
            })?;
            Ok(self.backbone.parser.bins.encode(action))
        };
        actions.map(|action| encode(action.actions.first())).collect()
    }

    /// The policy's actions with the backbone's reading. If the backbone's reasoning does not get to
    /// an action, it has read none of the decision's candidates, because they share the reasoning:
    /// all have the same features, so that a verifier prefers none of them.
    fn merge(&self, candidate: &Candidate, reading: Candidate) -> Candidate {
        let Ok(parsed) = &candidate.parsed else { return candidate.clone() };
        let malformed = match reading.parsed {
            Ok(Parsed { reasoning, .. }) => {
                return Candidate { parsed: Ok(Parsed { reasoning, ..parsed.clone() }), ..reading };
            }
            Err(malformed) => malformed,
        };
        if !self.is_unread_said.swap(true, Ordering::Relaxed) {
            tracing::warn!(
                "backbone: expected a reasoning and an action, got: {malformed}; the verifier cannot compare the \
                 candidates of such a decision (this is said once)"
            );
        }
        Candidate {
            tokens: Vec::new(),
            log_probability: 0.0,
            log_probabilities: Vec::new(),
            confidence: vec![0.0; TAGS.len() + ACTION_LENGTH],
            hidden: vec![0.0; self.info.hidden_size.unwrap_or_default()],
            parsed: candidate.parsed.clone(),
        }
    }
}

#[async_trait]
impl Policy for BackbonePolicy {
    fn info(&self) -> &PolicyInfo {
        &self.info
    }

    async fn propose(&self, requests: &[ProposalRequest<'_>]) -> Result<Vec<Proposal>> {
        // What the backbone cannot read is refused before the server is asked: asking it again would
        // move its chunks and histories on.
        let size = self.backbone.info().image_size;
        let mut images = Vec::with_capacity(requests.len());
        for request in requests {
            self.backbone.parser.prompter.ids(request.instruction)?;
            images.push(fit_image(request.image.clone(), size)?);
        }
        let proposals = self.policy.propose(requests).await?;
        self.read(requests, &images, proposals)
    }

    /// What the policy can sample, whatever chooses: the backbone has what a verifier needs.
    fn check(&self, setting: &Setting) -> Result<()> {
        let needs_hidden = setting.strategy.needs_verifier();
        let strategy = if needs_hidden { Strategy::Sample } else { setting.strategy };
        self.policy.check(&Setting { strategy, ..*setting })
    }
}

/// Identity of a policy whose candidates are read by a backbone.
fn read_digest(policy: &str, backbone: &str) -> String {
    format!("{:x}", Sha256::digest(format!("{policy} read by {backbone}")))
}
