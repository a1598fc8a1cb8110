//! What a decision was between: the candidates of one recorded step, as training sees them.

use anyhow::{Context, ensure};
use protocol::Statistics;

use super::records::Reader;
use store::record::{CandidateRecord, StepRecord, hidden_from_bytes};
use decision::CandidateAction;
use crate::verifier::{Features, Sibling, features, mean_hidden};
use decision::{ObjectTracker, TrackedObjects, ReasoningFeatures};

/// One decision in which the executed candidate was drawn, not chosen.
#[derive(Clone, Debug, PartialEq)]
pub struct DecisionSample {
    /// Mean hidden state of the well-formed candidates.
    pub hidden_mean: Vec<f32>,
    /// What the simulator had said after the step before, as 0 or 1; the verifier never sees it.
    pub statistics: [f32; STATISTICS],
    /// How each well-formed candidate differs from the others, without a target; the first was executed.
    pub candidates: Vec<Features>,
    /// What each of them would do.
    pub actions: Vec<[f32; 7]>,
    /// Where the gripper was: x and y in the base frame, metres.
    pub gripper: [f32; 2],
    /// What had been said until then.
    pub tracked: TrackedObjects,
}

impl DecisionSample {
    /// Whether the simulator had said that the object was in the gripper.
    pub fn is_grasped(&self) -> bool {
        self.statistics[1] > 0.5
    }
}

/// Flags of [`protocol::Statistics`].
pub const STATISTICS: usize = 9;

/// What a step's decision was between, remembering what was said; none when hidden states of well-formed candidates were not kept.
pub fn read(
    step: &StepRecord,
    before: Statistics,
    memory: &mut ObjectTracker,
    reader: Reader<'_>,
) -> anyhow::Result<Option<DecisionSample>> {
    let siblings = step.candidates.iter().map(|candidate| sibling(candidate, reader));
    let siblings = siblings.collect::<anyhow::Result<Vec<_>>>()?;
    let words: Vec<ReasoningFeatures> = siblings.iter().flatten().filter_map(|one| one.words).collect();
    let tracked = memory.note(&words);
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
    let candidates = features(&siblings, reader.action_scale, None).into_iter().flatten().collect();
    let [x, y, ..] = step.state;
    Ok(Some(DecisionSample {
        hidden_mean: mean_hidden(&rows, size),
        statistics: flags(before),
        candidates,
        actions: siblings.iter().flatten().map(|one| one.action.action).collect(),
        gripper: [x, y],
        tracked,
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
        words: (reader.words)(tokens),
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

#[cfg(test)]
mod tests {
    use super::*;
    use vla::PARTS;
    use store::record::hidden_to_bytes;
    use decision::{BoundingBox, Stage};

    /// Whoever says 7 is grasping something at 70, whoever says 9 is placing it at 90.
    fn words(tokens: &[u32]) -> Option<ReasoningFeatures> {
        let stage = if tokens[0] == 7 { Stage::Grasp } else { Stage::Place };
        let bounds = |side: f32| -> BoundingBox { [side, side, side + 1.0, side + 1.0] };
        Some(ReasoningFeatures { stage: Some(stage), bounds: [bounds(70.0), bounds(10.0 * tokens[0] as f32)] })
    }

    #[test]
    fn what_candidates_say_is_read_with_where_the_gripper_is() {
        let reader = Reader {
            policy: "cafe",
            action_scale: &[1.0; 7],
            confidence: &|_, _| [0.0; PARTS],
            words: &words,
        };
        let candidate = |said: u32, x: f32| CandidateRecord {
            tokens: vec![said; 7],
            action: (said > 0).then_some([x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
            malformed: None,
            score: None,
            log_probability: -1.0,
            log_probabilities: vec![-0.5; 7],
            hidden: Some(hidden_to_bytes(&[0.5])),
        };
        let step = |candidates: Vec<CandidateRecord>| StepRecord {
            state: [0.3, -0.1, 9.0, 9.0, 9.0, 9.0, 0.0, 1.0],
            candidates,
            chosen: Some(0),
            statistics: Statistics::default(),
            decision_ms: 1.0,
            step_ms: 1.0,
            simulator_ms: None,
        };
        let mut memory = ObjectTracker::default();
        let grasped = Statistics { is_grasped: true, ..Statistics::default() };
        let mut read = |candidates, before| {
            let sample = read(&step(candidates), before, &mut memory, reader);
            sample.expect("a whole step").expect("hidden states")
        };
        let first = read(vec![candidate(7, 0.1), candidate(7, 0.2)], Statistics::default());
        assert_eq!((first.gripper, first.is_grasped()), ([0.3, -0.1], false));
        assert_eq!(first.actions.iter().map(|action| action[0]).collect::<Vec<_>>(), [0.1, 0.2]);
        assert_eq!(first.tracked.stage, Some(Stage::Grasp));
        // The malformed one says nothing, and the second object is where both steps put it.
        let second = read(vec![candidate(9, 0.1), candidate(0, 0.0)], grasped);
        assert!(second.is_grasped() && second.actions.len() == 1);
        assert_eq!(second.tracked.stage, Some(Stage::Place));
        assert_eq!(second.tracked.bounds[0].map(|bounds| bounds[0]), Some(70.0));
        assert_eq!(second.tracked.bounds[1].map(|bounds| bounds[0]), Some(80.0));
    }
}
