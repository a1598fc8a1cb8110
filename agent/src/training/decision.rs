//! What a decision was between: the candidates of one recorded step, as training sees them.

use anyhow::{Context, ensure};
use protocol::Statistics;

use super::records::Reader;
use crate::record::{CandidateRecord, StepRecord, hidden_from_bytes};
use crate::strategy::CandidateAction;
use crate::verifier::{Features, Sibling, features, mean_hidden};

/// One decision in which the executed candidate was drawn, not chosen.
#[derive(Clone, Debug, PartialEq)]
pub struct DecisionSample {
    /// Mean hidden state of the well-formed candidates.
    pub hidden_mean: Vec<f32>,
    /// What the simulator had said after the step before, as 0 or 1; the verifier never sees it.
    pub statistics: [f32; STATISTICS],
    /// How each well-formed candidate differs from the others; the first was executed.
    pub candidates: Vec<Features>,
}

/// Flags of [`protocol::Statistics`].
pub const STATISTICS: usize = 9;

/// What a step's decision was between; none when hidden states of well-formed candidates were not kept.
pub fn read(
    step: &StepRecord,
    before: Statistics,
    reader: Reader<'_>,
) -> anyhow::Result<Option<DecisionSample>> {
    let siblings = step.candidates.iter().map(|candidate| sibling(candidate, reader));
    let siblings = siblings.collect::<anyhow::Result<Vec<_>>>()?;
    let well_formed = step.candidates.iter().filter(|candidate| candidate.action.is_some());
    let Some(bytes) = well_formed.map(|one| one.hidden.as_ref()).collect::<Option<Vec<_>>>() else {
        return Ok(None);
    };
    let rows = bytes.into_iter().map(|bytes| hidden_from_bytes(bytes));
    let rows = rows.collect::<anyhow::Result<Vec<Vec<f32>>>>()?;
    let size = rows.first().map_or(0, Vec::len);
    ensure!(
        rows.iter().all(|row| row.len() == size),
        "expected hidden states of one size, got several"
    );
    let rows: Vec<&[f32]> = rows.iter().map(Vec::as_slice).collect();
    let candidates = features(&siblings, reader.action_scale).into_iter().flatten().collect();
    Ok(Some(DecisionSample {
        hidden_mean: mean_hidden(&rows, size),
        statistics: flags(before),
        candidates,
    }))
}

/// The candidate beside others; none when it is malformed.
fn sibling(candidate: &CandidateRecord, reader: Reader<'_>) -> anyhow::Result<Option<Sibling>> {
    let CandidateRecord { tokens, log_probabilities, action, .. } = candidate;
    let Some(action) = *action else { return Ok(None) };
    let action_tokens = tokens.last_chunk();
    let action_tokens = action_tokens.filter(|_| tokens.len() == log_probabilities.len());
    let action_tokens = action_tokens.with_context(|| {
        format!(
            "expected at least 7 tokens with as many log-probabilities, got {} and {}",
            tokens.len(),
            log_probabilities.len()
        )
    })?;
    Ok(Some(Sibling {
        action: CandidateAction { tokens: *action_tokens, action },
        confidence: (reader.confidence)(tokens, log_probabilities),
    }))
}

/// In the order of the wire.
fn flags(statistics: Statistics) -> [f32; STATISTICS] {
    let flags = [
        statistics.is_success,
        statistics.is_grasped,
        statistics.ever_grasped,
        statistics.consecutive_grasp,
        statistics.moved_correct_object,
        statistics.moved_wrong_object,
        statistics.source_on_target,
        statistics.ever_success,
        statistics.released_success,
    ];
    flags.map(|flag| f32::from(u8::from(flag)))
}
