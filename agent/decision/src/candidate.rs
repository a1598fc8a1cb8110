//! The candidates that a policy proposes, each with reasoning and action, or malformed.

use protocol::message::Image;

use crate::{ActionChunk, EpisodeToken, Malformed, Reasoning};

/// The input of one decision.
#[derive(Clone, Copy)]
pub struct ProposalRequest<'a> {
    /// The camera image, in the policy's size.
    pub image: &'a Image,
    /// The robot's state, with the dimensions in the task's description.
    pub state: &'a [f32],
    /// The language instruction for the robot; letter case does not matter.
    pub instruction: &'a str,
    /// Number of candidates to sample; at least one.
    pub candidates: usize,
    /// Sampling temperature; 0 is greedy decoding.
    pub temperature: f32,
    /// Candidate i is sampled from its own random stream, derived from this seed and i.
    pub seed: u64,
    /// The episode of this decision; `None` for a decision by itself. A policy server keeps its
    /// state, and a client the connection, for as long as the episode lasts.
    pub episode: Option<&'a EpisodeToken>,
}

/// The candidates of one decision.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// In the order of their random streams.
    pub candidates: Vec<Candidate>,
}

/// One sampled candidate.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// All tokens from the first one after the prompt to the last action token, without `</s>`.
    /// Empty if the policy does not expose tokens.
    pub tokens: Vec<u32>,
    /// Log-probability of all tokens and of `</s>` at temperature 1, independent of the sampling
    /// temperature. 0 if the policy exposes neither this nor `log_probabilities`.
    pub log_probability: f32,
    /// Log-probability of each token at temperature 1; empty if the policy does not expose them.
    pub log_probabilities: Vec<f32>,
    /// Log-probability in nats of each section of the reasoning and of each dimension of the
    /// action; empty if the policy does not expose them.
    pub confidence: Vec<f32>,
    /// Hidden state of the last token after the final norm; empty if the policy does not expose it.
    pub hidden: Vec<f32>,
    /// The parsed reasoning and action, or the reason why parsing failed.
    pub parsed: Result<Parsed, Malformed>,
}

/// A well-formed candidate.
#[derive(Debug, Clone, PartialEq)]
pub struct Parsed {
    /// Empty for a policy that acts without reasoning.
    pub reasoning: Reasoning,
    /// Token ids of the sampled action bins; neighbouring bins have neighbouring ids. Empty if the
    /// policy has no action tokens.
    pub action_tokens: Vec<u32>,
    /// The actions to execute.
    pub actions: ActionChunk,
}

/// The action of a well-formed candidate: the only part that agreement and the oracle compare.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CandidateAction<'a> {
    /// As [`Parsed::action_tokens`].
    pub tokens: &'a [u32],
    /// As [`Parsed::actions`].
    pub actions: &'a ActionChunk,
}

impl Candidate {
    /// The action, or `None` if the candidate is malformed.
    pub fn action(&self) -> Option<CandidateAction<'_>> {
        let parsed = self.parsed.as_ref().ok()?;
        Some(CandidateAction { tokens: &parsed.action_tokens, actions: &parsed.actions })
    }
}
