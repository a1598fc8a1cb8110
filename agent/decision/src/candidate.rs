//! What a policy proposes: sampled candidates, each with reasoning and action, or malformed.

use protocol::message::Image;

use crate::{ActionChunk, Malformed, Reasoning};

/// One decision to be made.
#[derive(Clone, Copy)]
pub struct ProposalRequest<'a> {
    /// Of the policy's size.
    pub image: &'a Image,
    /// What the robot feels, as the task's description says.
    pub state: &'a [f32],
    /// What the robot is told to do, in any case of letters.
    pub instruction: &'a str,
    /// How many candidates to sample; at least one.
    pub candidates: usize,
    /// 0 takes the likeliest token each time.
    pub temperature: f32,
    /// Candidate i draws from a stream of its own, derived from this seed and i.
    pub seed: u64,
}

/// The candidates of one decision.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// In the order of their streams.
    pub candidates: Vec<Candidate>,
}

/// One sampled candidate.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// From the first token after the prompt to the last action token, without `</s>`; empty where a policy tells none.
    pub tokens: Vec<u32>,
    /// Of all tokens and of `</s>`, at temperature 1 whatever the temperature was.
    pub log_probability: f32,
    /// Of each token, at temperature 1.
    pub log_probabilities: Vec<f32>,
    /// Log-probability, in nats, of each part of the reasoning and of each number of the action.
    pub confidence: Vec<f32>,
    /// The last token's hidden state after the final norm; empty where a policy tells none.
    pub hidden: Vec<f32>,
    /// What the tokens mean, or why they mean nothing.
    pub parsed: Result<Parsed, Malformed>,
}

/// A well-formed candidate.
#[derive(Debug, Clone, PartialEq)]
pub struct Parsed {
    /// Empty for a policy that acts without reasoning.
    pub reasoning: Reasoning,
    /// Token ids of the action bins as sampled, neighbouring ids for neighbouring bins; empty where there are none.
    pub action_tokens: Vec<u32>,
    /// What to do.
    pub actions: ActionChunk,
}

/// What a well-formed candidate would do: the only part of it that agreement and the oracle look at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CandidateAction<'a> {
    /// As [`Parsed::action_tokens`].
    pub tokens: &'a [u32],
    /// As [`Parsed::actions`].
    pub actions: &'a ActionChunk,
}

impl Candidate {
    /// What it would do; none when it is malformed.
    pub fn action(&self) -> Option<CandidateAction<'_>> {
        let parsed = self.parsed.as_ref().ok()?;
        Some(CandidateAction { tokens: &parsed.action_tokens, actions: &parsed.actions })
    }
}
