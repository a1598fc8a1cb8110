//! What the policy proposes: sampled candidates, each parsed into reasoning and action, or refused.

use super::actions::ActionBins;
use super::config::ACTION_LENGTH;
use super::prompt::{LLAMA_SPACE, Prompter};
use super::reasoning::{Malformed, Reasoning};
use protocol::message::Image;

/// One decision to be made.
#[derive(Clone, Copy)]
pub struct ProposalRequest<'a> {
    /// Of the model's size.
    pub image: &'a Image,
    /// What the robot is told to do, in any case of letters.
    pub instruction: &'a str,
    /// How many completions to sample; at least one.
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

/// One sampled completion.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// From the first token after the prompt to the 7th action token, without `</s>`.
    pub tokens: Vec<u32>,
    /// Of all tokens and of `</s>`, at temperature 1 whatever the temperature was.
    pub log_probability: f32,
    /// Of each token, at temperature 1.
    pub log_probabilities: Vec<f32>,
    /// The last token's hidden state after the final norm.
    pub hidden: Vec<f32>,
    /// What the tokens mean, or why they mean nothing.
    pub parsed: Result<Parsed, Malformed>,
}

/// A well-formed candidate.
#[derive(Debug, Clone, PartialEq)]
pub struct Parsed {
    /// Empty for a model that acts without reasoning.
    pub reasoning: Reasoning,
    /// As sampled, before they were turned into numbers.
    pub action_tokens: [u32; ACTION_LENGTH],
    /// Metres, rotation vector in radians, and the gripper: +1 open, -1 closed.
    pub action: [f32; ACTION_LENGTH],
}

/// Whether nothing but `</s>` can follow, or nothing can make the completion well-formed any more.
pub fn is_complete(tokens: &[u32], bins: &ActionBins) -> bool {
    let Some(start) = tokens.iter().position(|&id| bins.contains(id)) else {
        return false;
    };
    let strange = tokens[start..].iter().any(|&id| !bins.contains(id));
    strange || tokens.len() > start + ACTION_LENGTH
}

/// Parses a completion whose `</s>` has been taken off.
pub fn parse(
    tokens: &[u32],
    reasoning: bool,
    bins: &ActionBins,
    prompter: &Prompter,
) -> Result<Parsed, Malformed> {
    let start = tokens.iter().position(|&id| bins.contains(id)).unwrap_or(tokens.len());
    let (thought, action) = tokens.split_at(start);
    let thought = match thought {
        // A Llama tokenizer's lone space before the action ids.
        [thought @ .., LLAMA_SPACE] => thought,
        thought => thought,
    };
    let text = prompter.text(thought);
    let reasoning = if reasoning {
        Reasoning::parse(&text)?
    } else if thought.is_empty() {
        Reasoning::default()
    } else {
        return Err(Malformed::new(format!("expected action tokens first, got {text:?}")));
    };
    let known = action.iter().take_while(|&&id| bins.contains(id)).count();
    if known < action.len() {
        let text = prompter.text(&action[known..known + 1]);
        let place = if known == ACTION_LENGTH { "the end" } else { "an action token" };
        return Err(Malformed::new(format!(
            "expected {place} after {known} action tokens, got {text:?}"
        )));
    }
    let action_tokens: [u32; ACTION_LENGTH] = action.try_into().map_err(|_| {
        Malformed::new(format!("expected {ACTION_LENGTH} action tokens, got {}", action.len()))
    })?;
    Ok(Parsed { reasoning, action_tokens, action: bins.decode(action_tokens) })
}
