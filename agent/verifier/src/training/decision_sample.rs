//! A decision for training: the candidates of one recorded step.

use anyhow::{Context, ensure};
use decision::{Candidate, Malformed, ObjectTracker, Parsed, ReasoningFeatures, TrackedObjects};
use protocol::Statistics;
use store::record::{CandidateRecord, DecisionRecord, Reading, hidden_from_bytes};

use super::records::CompletionReader;
use crate::{CandidateFeatures, mean_hidden};

/// A decision whose executed candidate was sampled, not selected.
#[derive(Clone, Debug, PartialEq)]
pub struct DecisionSample {
    /// Mean hidden state of the well-formed candidates.
    pub hidden_mean: Vec<f32>,
    /// The simulator's statistics after the previous step, as 0 or 1. The verifier never uses them.
    pub statistics: [f32; STATISTICS],
    /// The features of the well-formed candidates, without a target; the first one was executed.
    pub candidates: CandidateFeatures,
    /// The gripper's position: x and y in the base frame, in metres. `None` for a robot whose state
    /// starts with other dimensions.
    pub gripper: Option<[f32; 2]>,
    /// Object positions according to the reasoning so far.
    pub tracked: TrackedObjects,
}

impl DecisionSample {
    /// Whether the object was in the gripper according to the simulator.
    pub fn is_grasped(&self) -> bool {
        self.statistics[1] > 0.5
    }
}

/// Number of flags in [`protocol::Statistics`].
pub const STATISTICS: usize = 9;

/// Reads a decision with its state and statistics, and updates the tracker with its candidates.
/// `None` if hidden states of well-formed candidates are missing.
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
    // As during scoring, independent of whether a candidate was executed.
    let tracked = tracker.note(&said);
    let size = well_formed().next().map_or(0, |candidate| candidate.hidden.len());
    if well_formed().any(|candidate| candidate.hidden.is_empty()) {
        return Ok(None);
    }
    let rows: Vec<&[f32]> = well_formed().map(|candidate| &*candidate.hidden).collect();
    ensure!(
        rows.iter().all(|row| row.len() == size),
        "expected hidden states of equal length, got different lengths"
    );
    Ok(Some(DecisionSample {
        hidden_mean: mean_hidden(&rows, size),
        statistics: flags(before),
        candidates: CandidateFeatures::of(&candidates, reader.action_space)?,
        gripper: state.first_chunk().copied(),
        tracked,
    }))
}

/// The candidate as the policy proposed it; its hidden state is empty if the record does not
/// contain it.
pub fn candidate(
    record: &CandidateRecord,
    reader: CompletionReader<'_>,
) -> anyhow::Result<Candidate> {
    let CandidateRecord { tokens, log_probabilities, actions, malformed, hidden, reading, .. } =
        record;
    let (parsed, confidence) = match (actions, reading) {
        (None, _) => (Err(Malformed::new(malformed.clone().unwrap_or_default())), Vec::new()),
        (Some(actions), Some(Reading { reasoning, action_tokens, confidence })) => {
            let (reasoning, action_tokens) = (reasoning.clone(), action_tokens.clone());
            let parsed = Parsed { reasoning, action_tokens, actions: actions.clone() };
            (Ok(parsed), confidence.clone())
        }
        (Some(actions), None) => {
            ensure!(
                tokens.len() == log_probabilities.len(),
                "expected one log-probability per token, got {} for {} tokens",
                log_probabilities.len(),
                tokens.len()
            );
            let parsed = (reader.parse)(tokens).map_err(|malformed| {
                anyhow::anyhow!("expected a well-formed candidate: {malformed}")
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

/// The flags in the order of the protocol.
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

    /// A candidate with first token 7 is grasping something at 70; with first token 9 it is placing
    /// it at 90.
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
            unread: Vec::new(),
            score: None,
            log_probability: -1.0,
            log_probabilities: vec![-0.5; 7],
            hidden: Some(hidden_to_bytes(&[x])),
            reading: None,
        }
    }

    #[test]
    fn decisions_are_read_with_tracked_objects_and_the_gripper_position() {
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
        // The malformed candidate has no boxes; the second object is averaged over both decisions.
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
        assert_eq!(error, "expected one log-probability per token, got 1 for 7 tokens");
    }

    #[test]
    fn the_reading_of_a_candidate_takes_the_place_of_its_tokens() {
        let space = ActionSpace { scale: vec![1.0; 7], gripper: Some(6) };
        let reader = CompletionReader {
            policy: "cafe",
            action_space: &space,
            parse: &|_| Err(Malformed::new("expected no tokens")),
            confidence: &|_, _| Vec::new(),
        };
        let reasoning = parse(&[9]).expect("a reasoning").reasoning;
        let confidence = vec![-0.25; 16];
        let reading = Reading { reasoning: reasoning.clone(), confidence, ..Reading::default() };
        let recorded = CandidateRecord {
            tokens: Vec::new(),
            log_probabilities: Vec::new(),
            reading: Some(reading),
            ..record(9, 0.125)
        };
        let read = candidate(&recorded, reader).expect("a candidate");
        let parsed = read.parsed.expect("well formed");
        assert_eq!((parsed.reasoning, parsed.action_tokens), (reasoning, Vec::new()));
        assert_eq!((read.confidence, parsed.actions.first()[0]), (vec![-0.25; 16], 0.125));
        let error = candidate(&CandidateRecord { reading: None, ..recorded }, reader);
        assert!(error.expect_err("no tokens").to_string().contains("expected no tokens"));
    }
}
