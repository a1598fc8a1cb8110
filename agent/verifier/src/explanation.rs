//! Why a recorded candidate was ranked as it was: what each feature added to its advantage over its siblings.

use anyhow::Context;
use decision::{Candidate, ObjectTracker, ReasoningFeatures, TAGS};
use store::record::{DecisionRecord, EpisodeRecord};

use crate::training::decision_sample::candidate;
use crate::training::records::CompletionReader;
use crate::{CandidateFeatures, FeatureLayout, Ranking, Verifier};

/// The numbers of a Bridge action.
const BRIDGE_ACTION: [&str; 7] = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"];

/// One row for each well-formed candidate of a decision, in their order. A row has one number for each feature: what it adds
/// to the candidate's advantage, as a probability. The numbers of a row sum to the advantage.
pub type DecisionTerms = Vec<Vec<f32>>;

/// The terms of every step of a recorded episode; none for a step without a decision, and none at all for a verifier without a
/// ranking, whose scores are a network's and have no terms.
pub fn explain(
    verifier: &Verifier,
    record: &EpisodeRecord,
    reader: CompletionReader<'_>,
) -> anyhow::Result<Option<Vec<Option<DecisionTerms>>>> {
    let Some(ranking) = verifier.ranking() else { return Ok(None) };
    let mut tracker = ObjectTracker::default();
    let mut steps = Vec::with_capacity(record.steps.len());
    for (index, step) in record.steps.iter().enumerate() {
        let terms = step.decision.as_ref().map(|decision| {
            let said = (record.instruction.as_str(), step.state.as_slice());
            terms(ranking, decision, said, &mut tracker, reader)
        });
        steps.push(terms.transpose().with_context(|| format!("step {index}"))?);
    }
    Ok(Some(steps))
}

fn terms(
    ranking: &Ranking,
    decision: &DecisionRecord,
    (instruction, state): (&str, &[f32]),
    tracker: &mut ObjectTracker,
    reader: CompletionReader<'_>,
) -> anyhow::Result<DecisionTerms> {
    let candidates = decision.candidates.iter().map(|record| candidate(record, reader));
    let candidates = candidates.collect::<anyhow::Result<Vec<Candidate>>>()?;
    let parsed = candidates.iter().filter_map(|candidate| candidate.parsed.as_ref().ok());
    let said: Vec<ReasoningFeatures> =
        parsed.filter_map(|parsed| ReasoningFeatures::of(&parsed.reasoning)).collect();
    // Every decision is noted, as when it was made: the tracker remembers the whole episode.
    let tracked = tracker.note(&said);
    let mut features = CandidateFeatures::of(&candidates, reader.action_space)?;
    let gripper = state.first_chunk().copied();
    features.set_target(ranking.target_model().predict(instruction, &tracked, gripper));
    let row = |row: &Vec<f32>| {
        ranking.weights().iter().zip(row).map(|(weight, value)| weight * value).collect()
    };
    Ok(features.rows().iter().map(row).collect())
}

/// What each feature is, in the order of the terms.
pub fn term_names(layout: FeatureLayout) -> Vec<String> {
    let numbers: Vec<String> = match layout.action_length {
        7 => BRIDGE_ACTION.map(str::to_owned).to_vec(),
        length => (1..=length).map(|index| format!("action number {index}")).collect(),
    };
    let parts = TAGS.iter().map(|tag| format!("confidence in {}", tag.trim_end_matches(':')));
    let confidence = parts.chain(numbers.iter().map(|name| format!("confidence in {name}")));
    let deviations = numbers.iter().map(|name| format!("distance of {name} from the siblings"));
    let others = [
        "agreement with the siblings",
        "gripper nearer to the object",
        "gripper nearer to the destination",
    ];
    confidence.chain(deviations).chain(others.map(str::to_owned)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_feature_has_a_name_and_no_two_the_same() {
        for action_length in [1, 7, 14] {
            let layout = FeatureLayout { action_length };
            let names = term_names(layout);
            assert_eq!(names.len(), layout.length());
            let different: std::collections::BTreeSet<&String> = names.iter().collect();
            assert_eq!(different.len(), names.len());
        }
        let names = term_names(FeatureLayout { action_length: 7 });
        let layout = FeatureLayout { action_length: 7 };
        assert_eq!(names[layout.confidence().end - 1], "confidence in gripper");
        assert_eq!(names[layout.deviations().start], "distance of x from the siblings");
        assert_eq!(names[layout.nearness()], "agreement with the siblings");
        assert_eq!(names[layout.target().start], "gripper nearer to the object");
    }
}
