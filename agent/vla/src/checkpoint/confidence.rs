//! The policy's confidence in each part of a candidate: log-probabilities summed per ECoT tag and
//! per action dimension.

use crate::checkpoint::actions::ActionBins;
use crate::checkpoint::config::ACTION_LENGTH;
use crate::checkpoint::prompt::Prompter;
use decision::{TAGS, last_tag};

/// One part per tag, then one per action dimension.
const PARTS: usize = TAGS.len() + ACTION_LENGTH;

/// Lower bound of a token's log-probability: a single outlier must not dominate the sum.
const LOG_PROBABILITY_MIN: f32 = -8.0;

/// Sums `log_probabilities` (one per token) by part. A token belongs to the section in which it
/// ends; tokens before the first tag belong to the first section. Each action token is its own
/// part.
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
            // A malformed candidate may have more action tokens; it is never executed.
            TAGS.len() + (actions - 1).min(ACTION_LENGTH - 1)
        } else {
            // Every tag ends with a colon, so that only few prefixes have to be decoded.
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
