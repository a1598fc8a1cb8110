//! What a decision was between: the candidates of one recorded step, as training sees them.

use anyhow::{Context, ensure};
use decision::{Candidate, Malformed, ObjectTracker, Parsed, ReasoningFeatures, TrackedObjects};
use protocol::Statistics;
use store::record::{CandidateRecord, DecisionRecord, hidden_from_bytes};

use super::records::CompletionReader;
use crate::{CandidateFeatures, mean_hidden};

/// One decision in which the executed candidate was drawn, not selected.
#[derive(Clone, Debug, PartialEq)]
pub struct DecisionSample {
    /// Mean hidden state of the well-formed candidates.
    pub hidden_mean: Vec<f32>,
    /// What the simulator said after the step before, as 0 or 1; the verifier never sees it.
    pub statistics: [f32; STATISTICS],
    /// How each well-formed candidate differs from the others, without a target; the first was executed.
    pub candidates: CandidateFeatures,
    /// Where the gripper was: x and y in the base frame, metres; none for a robot whose state begins otherwise.
    pub gripper: Option<[f32; 2]>,
    /// Where the reasoning until then sees the objects.
    pub tracked: TrackedObjects,
}

impl DecisionSample {
    /// Whether the simulator said that the object was in the gripper.
    pub fn is_grasped(&self) -> bool {
        self.statistics[1] > 0.5
    }
}

/// Flags of [`protocol::Statistics`].
pub const STATISTICS: usize = 9;

/// Reads a decision whose state and statistics were these, and tracks what its candidates see; none when hidden states of
/// well-formed candidates were not kept.
pub fn read(
    decision: &DecisionRecord,
    state: &[f32],
    before: Statistics,
    tracker: &mut ObjectTracker,
    reader: CompletionReader<'_>,
) -> anyhow::Result<Option<DecisionSample>> {
    let candidates = decision.candidates.iter().map(|record| candidate(record, reader));
    let candidates = candidates.collect::<anyhow::Result<Vec<Candidate>>>()?;
    let well_formed = || candidates.iter().filter(|candidate| candidate.parsed.is_ok());
    let parsed = candidates.iter().filter_map(|candidate| candidate.parsed.as_ref().ok());
    let said: Vec<ReasoningFeatures> =
        parsed.filter_map(|parsed| ReasoningFeatures::of(&parsed.reasoning)).collect();
    // As when it was scored, whether or not one of them was executed.
    let tracked = tracker.note(&said);
    let size = well_formed().next().map_or(0, |candidate| candidate.hidden.len());
    if well_formed().any(|candidate| candidate.hidden.is_empty()) {
        return Ok(None);
    }
    let rows: Vec<&[f32]> = well_formed().map(|candidate| &*candidate.hidden).collect();
    ensure!(
        rows.iter().all(|row| row.len() == size),
        "expected hidden states of one size, got several"
    );
    Ok(Some(DecisionSample {
        hidden_mean: mean_hidden(&rows, size),
        statistics: flags(before),
        candidates: CandidateFeatures::of(&candidates, reader.action_space)?,
        gripper: state.first_chunk().copied(),
        tracked,
    }))
}

/// The candidate as the policy gave it; its hidden state is empty where it was not kept.
pub fn candidate(
    record: &CandidateRecord,
    reader: CompletionReader<'_>,
) -> anyhow::Result<Candidate> {
    let CandidateRecord { tokens, log_probabilities, actions, malformed, hidden, .. } = record;
    let (parsed, confidence) = match actions {
        None => (Err(Malformed::new(malformed.clone().unwrap_or_default())), Vec::new()),
        Some(actions) => {
            ensure!(
                tokens.len() == log_probabilities.len(),
                "expected as many log-probabilities as tokens, got {} and {}",
                log_probabilities.len(),
                tokens.len()
            );
            let parsed = (reader.parse)(tokens).map_err(|malformed| {
                anyhow::anyhow!("expected the tokens of a well-formed candidate: {malformed}")
            })?;
            let confidence = (reader.confidence)(tokens, log_probabilities);
            (Ok(Parsed { actions: actions.clone(), ..parsed }), confidence)
        }
    };
    let hidden = hidden.as_deref().map(hidden_from_bytes).transpose().context("candidate")?;
    Ok(Candidate {
        tokens: tokens.clone(),
        log_probability: record.log_probability,
        log_probabilities: log_probabilities.clone(),
        confidence,
        hidden: hidden.unwrap_or_default(),
        parsed,
    })
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
    use decision::{ActionChunk, ActionSpace, Reasoning, Stage, VisibleObject};
    use store::record::hidden_to_bytes;

    /// A candidate whose first token is 7 is grasping something at 70, one with a 9 is placing it at 90.
    fn parse(tokens: &[u32]) -> Result<Parsed, Malformed> {
        let side = tokens[0] as u16 * 10;
        let object = |side: u16| VisibleObject {
            name: "thing".to_owned(),
            bounding_box: [side, side, side + 1, side + 1],
        };
        let reasoning = Reasoning {
            subtask: if tokens[0] == 7 { "grasp it" } else { "release it" }.to_owned(),
            visible_objects: vec![object(70), object(side)],
            ..Reasoning::default()
        };
        let actions = ActionChunk::single(vec![0.0; 7]).expect("finite");
        Ok(Parsed { reasoning, action_tokens: vec![1; 7], actions })
    }

    fn record(first_token: u32, x: f32) -> CandidateRecord {
        let action = vec![x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        CandidateRecord {
            tokens: vec![first_token; 7],
            actions: (first_token > 0).then(|| ActionChunk::single(action).expect("finite")),
            malformed: (first_token == 0).then(|| "expected an action, got none".to_owned()),
            score: None,
            log_probability: -1.0,
            log_probabilities: vec![-0.5; 7],
            hidden: Some(hidden_to_bytes(&[x])),
        }
    }

    #[test]
    fn decisions_are_read_with_what_their_candidates_see_and_where_the_gripper_is() {
        let space = ActionSpace { scale: vec![1.0; 7], gripper: Some(6) };
        let reader = CompletionReader {
            policy: "cafe",
            action_space: &space,
            parse: &parse,
            confidence: &|_, _| vec![0.0; 16],
        };
        let mut tracker = ObjectTracker::default();
        let grasped = Statistics { is_grasped: true, ..Statistics::default() };
        let mut read = |candidates, before| {
            let decision =
                DecisionRecord { candidates, chosen: Some(0), batch_ms: 1.0, batch_size: 1 };
            read(&decision, &[0.3, -0.1, 9.0], before, &mut tracker, reader)
        };
        let first = read(vec![record(7, 0.125), record(7, 0.25)], Statistics::default());
        let first = first.expect("a whole decision").expect("hidden states");
        assert_eq!((first.gripper, first.is_grasped()), (Some([0.3, -0.1]), false));
        assert_eq!(first.hidden_mean, [0.1875]);
        assert_eq!(first.candidates.rows().len(), 2);
        assert_eq!(first.tracked.stage, Some(Stage::Grasp));
        // The malformed one says nothing, and the second object is where both decisions see it.
        let second = read(vec![record(9, 0.125), record(0, 0.0)], grasped);
        let second = second.expect("a whole decision").expect("hidden states");
        assert!(second.is_grasped() && second.candidates.rows().len() == 1);
        assert_eq!(second.tracked.stage, Some(Stage::Place));
        assert_eq!(second.tracked.bounds[0].map(|bounds| bounds[0]), Some(70.0));
        assert_eq!(second.tracked.bounds[1].map(|bounds| bounds[0]), Some(80.0));
        let forgotten = CandidateRecord { hidden: None, ..record(9, 0.125) };
        let third = read(vec![record(9, 0.125), forgotten], grasped).expect("a whole decision");
        assert_eq!(third, None);
        let short = CandidateRecord { log_probabilities: vec![-0.5], ..record(9, 0.125) };
        let error = read(vec![short], grasped).expect_err("damaged").to_string();
        assert_eq!(error, "expected as many log-probabilities as tokens, got 1 and 7");
    }
}
