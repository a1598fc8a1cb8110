//! The decode loop: one prefill per session, then one token per step for all candidates together.
//!
//! Candidates of a session with the same tokens so far share one row of the batch.

use std::collections::HashMap;

use anyhow::Result;
use candle_core::Tensor;
use rayon::prelude::*;

use crate::checkpoint::actions::ActionBins;
use crate::checkpoint::config::ACTION_LENGTH;
use crate::checkpoint::parse::{is_action, is_complete};
use crate::generate::sampling::{Draw, Stream, draw, forced};
use crate::kernels::segment::GROWTH;
use crate::network::forward::{Context, Network};

/// One session's prompt and how to continue it.
pub struct Continuation<'a> {
    pub context: Context<'a>,
    pub candidates: usize,
    pub temperature: f32,
    pub seed: u64,
    /// Maximum length of a completion; a longer one is cut after one more token.
    pub tokens_max: usize,
    /// The action tokens of each candidate, if the network is to read actions instead of choosing
    /// them: what comes before the action is still drawn. Empty otherwise.
    pub actions: &'a [[u32; ACTION_LENGTH]],
}

/// The conditions under which a completion ends.
pub struct Limits<'a> {
    pub bins: &'a ActionBins,
    /// Ids from here on are padding of the embedding and are never sampled.
    pub vocabulary: usize,
    pub end: u32,
    /// Whether a completion is complete after an action without `</s>`: policies without a chain
    /// of thought may be trained without it, and their reference does not wait for it.
    pub action_ends: bool,
}

/// A completion that is finished or in progress.
pub struct Completion {
    pub session: usize,
    /// Without `</s>`.
    pub tokens: Vec<u32>,
    pub log_probability: f64,
    /// Log-probability of each token.
    pub log_probabilities: Vec<f32>,
    /// Hidden state of the last token.
    pub hidden: Vec<f32>,
    temperature: f32,
    stream: Stream,
    tokens_max: usize,
    /// The action tokens of a completion whose action is given.
    action: Option<[u32; ACTION_LENGTH]>,
    /// The row that computes this completion. Completions of a session share a row as long as they
    /// agree.
    row: Option<usize>,
}

/// A row of the next step: an earlier row extended by one token.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct Row {
    parent: usize,
    token: u32,
}

/// All completions, ordered by session and then by candidate.
pub fn complete(
    network: &Network,
    sessions: &[Continuation<'_>],
    limits: &Limits<'_>,
) -> Result<Vec<Completion>> {
    let contexts: Vec<Context<'_>> = sessions.iter().map(|session| session.context).collect();
    let (prefix, hidden) = network.prefill_all(&contexts)?;
    let decoder = &network.decoder;
    let mut completions = start(sessions);
    let mut rows = extend(&mut completions, &hidden, &decoder.logits(&hidden)?, limits)?;
    // In the first step, a row's parent is its session.
    let parents: Vec<usize> = rows.iter().map(|row| row.parent).collect();
    let mut tail = decoder.tails(parents, GROWTH);
    while !rows.is_empty() {
        let ids: Vec<u32> = rows.iter().map(|row| row.token).collect();
        let hidden = decoder.step(&ids, &prefix, &mut tail)?;
        let next = extend(&mut completions, &hidden, &decoder.logits(&hidden)?, limits)?;
        let parents: Vec<usize> = next.iter().map(|row| row.parent).collect();
        if parents.len() != rows.len() || !parents.is_sorted_by(|a, b| a < b) {
            tail.fork(&parents)?;
        }
        rows = next;
    }
    Ok(completions)
}

fn start(sessions: &[Continuation<'_>]) -> Vec<Completion> {
    let completions = sessions.iter().enumerate().flat_map(|(index, session)| {
        (0..session.candidates).map(move |candidate| Completion {
            session: index,
            tokens: Vec::new(),
            log_probability: 0.0,
            log_probabilities: Vec::new(),
            hidden: Vec::new(),
            temperature: session.temperature,
            stream: Stream::new(session.seed, candidate),
            tokens_max: session.tokens_max,
            action: session.actions.get(candidate).copied(),
            row: Some(index),
        })
    });
    completions.collect()
}

/// Samples the next token of every unfinished completion; returns the rows that must be computed
/// next.
fn extend(
    completions: &mut [Completion],
    hidden: &Tensor,
    logits: &Tensor,
    limits: &Limits<'_>,
) -> Result<Vec<Row>> {
    let hidden: Vec<Vec<f32>> = hidden.to_vec2()?;
    let logits: Vec<Vec<f32>> = logits.to_vec2()?;
    let next = completions.par_iter_mut().map(|completion| {
        let Some(row) = completion.row else { return Ok(None) };
        completion.hidden.clone_from(&hidden[row]);
        let token = completion.draw(&logits[row][..limits.vocabulary], limits)?;
        Ok(token.map(|token| Row { parent: row, token }))
    });
    let next = next.collect::<Result<Vec<Option<Row>>>>()?;
    // Completions of one session with equal tokens so far are computed once.
    let (mut rows, mut known) = (Vec::new(), HashMap::new());
    for (completion, next) in completions.iter_mut().zip(next) {
        completion.row = next.map(|row| {
            *known.entry(row).or_insert_with(|| {
                rows.push(row);
                rows.len() - 1
            })
        });
    }
    Ok(rows)
}

impl Completion {
    /// The next token, or `None` when the completion is finished.
    fn draw(&mut self, logits: &[f32], limits: &Limits<'_>) -> Result<Option<u32>> {
        let drawn = draw(logits, self.temperature, self.stream.uniform())?;
        let Draw { token, log_probability } = match self.given(drawn.token, limits) {
            Some(token) => forced(logits, token)?,
            None => drawn,
        };
        if limits.action_ends && token != limits.end && is_action(&self.tokens, limits.bins) {
            // The token is not part of the candidate. This step was computed for the hidden state
            // of the last action token.
            return Ok(None);
        }
        self.log_probability += log_probability;
        if token == limits.end {
            return Ok(None);
        }
        self.tokens.push(token);
        self.log_probabilities.push(log_probability as f32);
        let done = self.tokens.len() > self.tokens_max || is_complete(&self.tokens, limits.bins);
        Ok(if done { None } else { Some(token) })
    }

    /// The token of a given action, once the network begins an action; then the end.
    fn given(&self, drawn: u32, limits: &Limits<'_>) -> Option<u32> {
        let action = self.action?;
        match self.tokens.iter().position(|&id| limits.bins.contains(id)) {
            None => limits.bins.contains(drawn).then_some(action[0]),
            Some(start) => match action.get(self.tokens.len() - start) {
                Some(token) => Some(*token),
                // Where an action ends without it, as for drawn ones, the network decides.
                None => (!limits.action_ends).then_some(limits.end),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checkpoint::config::ActionScale;

    const END: u32 = 2;

    /// The tokens of a greedy completion if the network wants `ids`, and their log-probability.
    fn completed(ids: &[u32], action_ends: bool) -> (Vec<u32>, f64) {
        completed_with(ids, action_ends, None)
    }

    fn completed_with(
        ids: &[u32],
        action_ends: bool,
        action: Option<[u32; ACTION_LENGTH]>,
    ) -> (Vec<u32>, f64) {
        let scale = ActionScale { q01: [0.0; 7], q99: [1.0; 7], mask: [true; 7] };
        let bins = ActionBins::new(300, 256, scale);
        let limits = Limits { bins: &bins, vocabulary: 300, end: END, action_ends };
        let mut completion = Completion {
            session: 0,
            tokens: Vec::new(),
            log_probability: 0.0,
            log_probabilities: Vec::new(),
            hidden: Vec::new(),
            temperature: 0.0,
            stream: Stream::new(0, 0),
            tokens_max: 8,
            action,
            row: Some(0),
        };
        for &id in ids {
            let logits: Vec<f32> = (0..300).map(|one| if one == id { 1.0 } else { 0.0 }).collect();
            if completion.draw(&logits, &limits).expect("logits").is_none() {
                break;
            }
        }
        (completion.tokens, completion.log_probability)
    }

    #[test]
    fn an_action_without_an_end_token_is_complete_for_a_policy_without_reasoning() {
        let action = [100, 101, 102, 103, 104, 105, 106];
        let (ended, more) = ([&action[..], &[END]].concat(), [&action[..], &[107]].concat());
        // Seven or eight tokens of equal likelihood.
        let one = completed(&action[..1], true).1;
        for action_ends in [true, false] {
            let (tokens, sum) = completed(&ended, action_ends);
            assert_eq!(tokens, action);
            assert!((sum - 8.0 * one).abs() < 1e-9);
        }
        let (tokens, sum) = completed(&more, true);
        assert_eq!(tokens, action, "the eighth token is not part of it");
        assert!((sum - 7.0 * one).abs() < 1e-9);
        assert_eq!(completed(&more, false).0, more, "a chain of thought must end");
        let late = [&[5], &action[..]].concat();
        assert_eq!(completed(&late, true).0, late, "an action comes first or is none");
    }

    #[test]
    fn a_given_action_replaces_that_of_the_network_and_nothing_before_it() {
        let given = [110, 111, 112, 113, 114, 115, 116];
        // The network would write 5, an action and then an eighth action token.
        let wanted = [5, 100, 101, 102, 103, 104, 105, 106, 107];
        let (tokens, sum) = completed_with(&wanted, false, Some(given));
        assert_eq!(tokens, [&[5], &given[..]].concat());
        // One token that the network wants, and eight, with the end, that it does not.
        let (likely, unlikely) =
            (completed(&[5], true).1, completed_with(&[100], true, Some(given)).1);
        assert!((sum - likely - 8.0 * unlikely).abs() < 1e-9, "{sum}");
        assert_eq!(completed_with(&[5, 6, END], false, Some(given)).0, [5, 6], "no action begins");
    }
}
