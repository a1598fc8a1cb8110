//! Tests of the strategies on synthetic candidates.

use super::*;
use crate::ActionChunk;

/// A candidate's tokens and action.
type Owned = Option<(Vec<u32>, ActionChunk)>;

fn space() -> ActionSpace {
    ActionSpace { scale: vec![0.02, 0.02, 0.02, 0.1, 0.1, 0.1, 2.0], gripper: Some(6) }
}

fn owned(tokens: [u32; 7], action: [f32; 7]) -> Owned {
    Some((tokens.to_vec(), ActionChunk::single(action.to_vec()).expect("an action")))
}

/// A candidate with `bin` as its first bin; its other five continuous bins are always the same.
fn at(bin: u32, gripper: f32) -> Owned {
    let tokens = [bin, 500, 500, 500, 500, 500, if gripper > 0.0 { 599 } else { 400 }];
    owned(tokens, [bin as f32 * 1e-4, 0.0, 0.0, 0.0, 0.0, 0.0, gripper])
}

fn check(strategy: &str, candidates: &[Owned], logits: &[f32], expected: Option<usize>) {
    let expert_action = [0.0502, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let borrowed: Vec<_> = candidates
        .iter()
        .map(|one| one.as_ref().map(|(tokens, actions)| CandidateAction { tokens, actions }))
        .collect();
    let alternatives = Alternatives {
        candidates: &borrowed,
        logits: Some(logits),
        expert_action: Some(&expert_action),
        action_space: &space(),
    };
    let strategy: Strategy = strategy.parse().expect("a known name");
    assert_eq!(strategy.choose(&alternatives), expected, "{strategy}");
}

#[test]
fn every_strategy_selects_its_own_candidate() {
    // Candidates 1, 2 and 5 agree; 3 is far away; 4 has the opposite gripper command.
    let candidates =
        [at(470, 1.0), at(510, 1.0), at(512, 1.0), at(560, 1.0), at(511, -1.0), at(507, 1.0)];
    let logits = [0.5, -0.5, 0.0, 1.5, -2.0, 0.4];
    check("greedy", &candidates, &logits, Some(0));
    check("sample", &candidates, &logits, Some(0));
    check("first-well-formed", &candidates, &logits, Some(0));
    check("majority", &candidates, &logits, Some(1));
    check("medoid", &candidates, &logits, Some(1));
    check("verifier", &candidates, &logits, Some(3));
    check("worst", &candidates, &logits, Some(4));
    check("oracle", &candidates, &logits, Some(5));
}

#[test]
fn malformed_candidates_are_never_chosen() {
    let logits = [9.0, 0.0, -9.0];
    for strategy in Strategy::ALL {
        check(strategy.name(), &[None, None, None], &logits, None);
        check(strategy.name(), &[], &[], None);
    }
    for strategy in &Strategy::ALL[2..] {
        check(strategy.name(), &[None, at(500, 1.0), None], &logits, Some(1));
    }
    // A single sample is one candidate: a later candidate must not replace a malformed first one.
    check("sample", &[None, at(500, 1.0), None], &logits, None);
}

#[test]
fn ties_go_to_the_first() {
    let candidates = [None, at(500, 1.0), at(500, 1.0), at(500, 1.0)];
    for strategy in &Strategy::ALL[2..] {
        check(strategy.name(), &candidates, &[1.0; 4], Some(1));
    }
    // No two candidates agree: all have the same number of votes.
    check("majority", &[at(400, 1.0), at(500, 1.0), at(600, 1.0)], &[0.0; 3], Some(0));
}

#[test]
fn majority_counts_votes_within_three_bins_on_the_same_gripper_side() {
    check("majority", &[at(500, 1.0), at(510, 1.0), at(513, 1.0)], &[0.0; 3], Some(1));
    check("majority", &[at(500, 1.0), at(510, 1.0), at(514, 1.0)], &[0.0; 3], Some(0));
    check("majority", &[at(500, 1.0), at(510, 1.0), at(510, -1.0)], &[0.0; 3], Some(0));
    // 503 is near both of its neighbours, which are not near each other.
    check("majority", &[at(500, 1.0), at(503, 1.0), at(506, 1.0)], &[0.0; 3], Some(1));
}

#[test]
fn gripper_disagreement_counts_for_the_medoid() {
    check("medoid", &[at(500, -1.0), at(490, 1.0), at(510, 1.0)], &[0.0; 3], Some(1));
    check("medoid", &[at(500, 1.0), at(490, 1.0), at(510, 1.0)], &[0.0; 3], Some(0));
}

#[test]
fn a_confident_verifier_overrules_agreement_and_an_indifferent_one_does_not() {
    let candidates = [440, 500, 503, 501, 502].map(|bin| at(bin, 1.0));
    check("verifier+medoid", &candidates, &[0.1, 0.0, 0.0, 0.0, 0.0], Some(3));
    check("verifier+medoid", &candidates, &[3.0, 0.0, 0.0, 0.0, 0.0], Some(0));
    // The mean distances are 61.5/255 and 16.25/255. Check both sides of the point where the
    // decision changes.
    let turn = (MEDOID_WEIGHT_LOGITS * (61.5 - 16.25) / 255.0) as f32;
    check("verifier+medoid", &candidates, &[turn - 0.001, 0.0, 0.0, 0.0, 0.0], Some(3));
    check("verifier+medoid", &candidates, &[turn + 0.001, 0.0, 0.0, 0.0, 0.0], Some(0));
}

#[test]
fn the_oracle_measures_in_units_of_the_action_scale() {
    let mut far_in_metres = [0.0502, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    far_in_metres[0] += 0.02; // one whole unit
    let mut far_in_radians = [0.0502, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    far_in_radians[3] += 0.05; // half a unit, though the larger number
    let with = |action| owned([500; 7], action);
    check("oracle", &[with(far_in_metres), with(far_in_radians)], &[0.0; 2], Some(1));
    let distance =
        expert_distance(&far_in_metres, &[0.0502, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0], &space().scale);
    assert!((distance - 2.0_f64.sqrt()).abs() < 1e-5, "{distance}");
    let without_range = expert_distance(&far_in_metres, &[0.0; 7], &[0.0; 7]);
    assert_eq!(without_range, 0.0);
}

#[test]
fn names_are_read_back() {
    for strategy in Strategy::ALL {
        assert_eq!(strategy.to_string().parse(), Ok(strategy));
    }
    let error = "Verifier".parse::<Strategy>().expect_err("names are lower case");
    assert_eq!(
        error.to_string(),
        "strategy: expected one of greedy, sample, first-well-formed, majority, medoid, verifier, worst, verifier+medoid, oracle, got \"Verifier\"",
    );
    assert_eq!(Strategy::Sample.candidates(5), 1);
    assert_eq!(Strategy::Medoid.candidates(5), 5);
    assert_eq!(Strategy::Greedy.temperature(1.0), 0.0);
    assert_eq!(Strategy::Worst.temperature(0.7), 0.7);
}

#[test]
#[should_panic(expected = "is finite")]
fn a_score_that_is_not_finite_is_a_bug() {
    check("verifier", &[at(500, 1.0)], &[f32::NAN], Some(0));
}

#[test]
fn candidates_without_tokens_are_compared_by_their_actions() {
    let bare = |x: f32, gripper: f32| -> Owned {
        let action = vec![x, 0.0, 0.0, 0.0, 0.0, 0.0, gripper];
        Some((Vec::new(), ActionChunk::single(action).expect("an action")))
    };
    // One bin is 0.02 / 255 here. The first two agree; the others are far away or have the opposite
    // gripper command.
    let candidates = [bare(0.01, 1.0), bare(0.0101, 1.0), bare(0.02, 1.0), bare(0.01, -1.0)];
    check("majority", &candidates, &[0.0; 4], Some(0));
    check("medoid", &candidates[..3], &[0.0; 3], Some(1));
}

#[test]
fn all_actions_of_a_chunk_count() {
    let chunk = |x: [f32; 2]| -> Owned {
        let action = |x: f32| vec![x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        Some((Vec::new(), ActionChunk::new(x.map(action).to_vec()).expect("a chunk")))
    };
    // The first actions are equal; the second ones decide.
    let candidates = [chunk([0.01, 0.02]), chunk([0.01, 0.0]), chunk([0.01, 0.001])];
    check("medoid", &candidates, &[0.0; 3], Some(2));
}
