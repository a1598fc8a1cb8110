//! Parses a completion into reasoning and action, or reports why it is malformed.

use decision::{ActionChunk, Malformed, Parsed, Reasoning};

use super::actions::ActionBins;
use super::config::{ACTION_LENGTH, Config};
use super::prompt::{LLAMA_SPACE, Prompter};

/// Whether these are the tokens of one action and nothing else.
pub fn is_action(tokens: &[u32], bins: &ActionBins) -> bool {
    tokens.len() == ACTION_LENGTH && tokens.iter().all(|&id| bins.contains(id))
}

/// Whether only `</s>` can follow, or the completion cannot become well-formed any more.
pub fn is_complete(tokens: &[u32], bins: &ActionBins) -> bool {
    let Some(start) = tokens.iter().position(|&id| bins.contains(id)) else {
        return false;
    };
    let strange = tokens[start..].iter().any(|&id| !bins.contains(id));
    strange || tokens.len() > start + ACTION_LENGTH
}

/// Parses a completion without its `</s>`.
pub fn parse(
    tokens: &[u32],
    config: &Config,
    bins: &ActionBins,
    prompter: &Prompter,
) -> Result<Parsed, Malformed> {
    let start = tokens.iter().position(|&id| bins.contains(id)).unwrap_or(tokens.len());
    let (thought, action) = tokens.split_at(start);
    let thought = match thought {
        // The single space that a Llama tokenizer inserts before action tokens.
        [thought @ .., LLAMA_SPACE] => thought,
        thought => thought,
    };
    let text = prompter.text(thought);
    let reasoning = if config.partial_reasoning {
        Reasoning::read(&text)
    } else if config.reasoning {
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
    let actions = ActionChunk::single(bins.decode(action_tokens).to_vec())
        .map_err(|error| Malformed::new(error.to_string()))?;
    Ok(Parsed { reasoning, action_tokens: action_tokens.to_vec(), actions })
}
