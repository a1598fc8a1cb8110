//! The candidates of a server's answers.

use anyhow::{Context, Result, ensure};
use decision::{ActionChunk, Candidate, Malformed, Parsed, Reasoning};

use super::connection::Reply;
use crate::Profile;
use crate::codec::extension::{Announcement, AnswerCandidate};

/// The candidate of an answer without optional fields.
pub fn of_actions(profile: &Profile, actions: &[Vec<f32>]) -> Result<Candidate> {
    Ok(Candidate {
        tokens: Vec::new(),
        log_probability: 0.0,
        log_probabilities: Vec::new(),
        confidence: Vec::new(),
        hidden: Vec::new(),
        parsed: Ok(parsed(profile.actions.chunk(actions)?)),
    })
}

/// The candidates of an answer to a request for `count` candidates.
pub fn of_answer(
    profile: &Profile,
    announced: &Announcement,
    reply: Reply,
    count: usize,
) -> Result<Vec<Candidate>> {
    let answer = reply.answer.context("expected the announced fields \"rever\", got none")?;
    let got = answer.candidates.len();
    ensure!(got == count, "expected {count} candidates, got {got}");
    ensure!(
        answer.digest.is_none() || answer.digest == announced.digest,
        "expected the policy {}, got {}",
        announced.digest.as_deref().unwrap_or("without a digest"),
        answer.digest.as_deref().unwrap_or_default()
    );
    let candidates = answer.candidates.into_iter().enumerate();
    let read = |(index, candidate)| {
        of_candidate(profile, announced, candidate).with_context(|| format!("candidate {index}"))
    };
    candidates.map(read).collect()
}

fn of_candidate(
    profile: &Profile,
    announced: &Announcement,
    sent: AnswerCandidate,
) -> Result<Candidate> {
    for (name, expected, got) in [
        ("hidden", announced.hidden_size, sent.hidden.len()),
        ("confidence", announced.confidence_size, sent.confidence.len()),
    ] {
        // Nothing reads those of a malformed candidate.
        let is_right = sent.malformed.is_some() || expected.is_none_or(|expected| got == expected);
        ensure!(is_right, "{name}: expected {} numbers, got {got}", expected.unwrap_or_default());
    }
    let (tokens, steps) = (sent.log_probabilities.len(), sent.tokens.len());
    ensure!(
        tokens == 0 || tokens == steps,
        "log_probabilities: expected one for each of {steps} tokens, got {tokens}"
    );
    let parsed = match sent.malformed {
        Some(reason) => Err(Malformed::new(reason)),
        None => {
            let mut parsed = parsed(profile.actions.chunk(&sent.actions)?);
            parsed.action_tokens = sent.action_tokens;
            if let Some(text) = &sent.reasoning {
                parsed.reasoning = Reasoning::read(text);
            }
            Ok(parsed)
        }
    };
    let sum = || sent.log_probabilities.iter().sum();
    Ok(Candidate {
        log_probability: sent.log_probability.unwrap_or_else(sum),
        tokens: sent.tokens,
        log_probabilities: sent.log_probabilities,
        confidence: sent.confidence,
        hidden: sent.hidden,
        parsed,
    })
}

/// An action without reasoning.
fn parsed(actions: ActionChunk) -> Parsed {
    Parsed { reasoning: Reasoning::default(), action_tokens: Vec::new(), actions }
}

/// Whether several well-formed candidates have exactly the same actions.
pub fn are_identical(candidates: &[Candidate]) -> bool {
    let mut actions = candidates.iter().filter_map(Candidate::action).map(|action| action.actions);
    let Some(first) = actions.next() else { return false };
    candidates.len() > 1 && actions.all(|other| other == first)
}
