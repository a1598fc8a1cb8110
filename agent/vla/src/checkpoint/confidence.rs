//! How sure the policy was of each part of a candidate: its log-probabilities, summed by ECoT's tags and action numbers.

use crate::checkpoint::actions::ActionBins;
use crate::checkpoint::config::ACTION_LENGTH;
use crate::checkpoint::prompt::Prompter;
use decision::{TAGS, last_tag};

/// One part for each tag's text, then one for each number of the action.
const PARTS: usize = TAGS.len() + ACTION_LENGTH;

/// A token counts as no less likely than e^-8: a single outlier must not outweigh all the rest.
const LOG_PROBABILITY_MIN: f32 = -8.0;

/// Sums `log_probabilities`, one of each token, by part. A token belongs to the tag in whose text it ends, what comes
/// before any tag to the first; the action's tokens stand for themselves.
pub fn confidence(
    tokens: &[u32],
    log_probabilities: &[f32],
    bins: &ActionBins,
    prompter: &Prompter,
) -> Vec<f32> {
    assert_eq!(tokens.len(), log_probabilities.len(), "one log-probability per token");
    let mut confidence = vec![0.0; PARTS];
    let (mut section, mut length, mut actions) = (0, 0, 0);
    for (index, (&token, log_probability)) in tokens.iter().zip(log_probabilities).enumerate() {
        let part = if bins.contains(token) {
            actions += 1;
            // A malformed candidate may have more; nobody executes it.
            TAGS.len() + (actions - 1).min(ACTION_LENGTH - 1)
        } else {
            // A tag ends with a colon, so that only few prefixes must be read.
            if prompter.has_colon(token) {
                let text = prompter.text(&tokens[..=index]);
                section = last_tag(&text, length).unwrap_or(section);
                length = text.len();
            }
            section
        };
        confidence[part] += log_probability.max(LOG_PROBABILITY_MIN);
    }
    confidence
}
