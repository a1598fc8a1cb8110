//! How one of several candidates is chosen: a strategy turns a decision into an index.
//!
//! Every strategy sees plain data, so that a choice can be repeated from a record. A malformed candidate is never chosen;
//! of equally good candidates the first wins. When nothing can be chosen the answer is `None` and the robot holds still.

use std::fmt;
use std::str::FromStr;

/// Two candidates vote for each other in [`Strategy::Majority`] when no continuous action token differs by more bins.
///
/// Exact agreement of seven tokens is rare with 256 bins per dimension, so that a strict vote would be a plain sample.
pub const MAJORITY_TOLERANCE_BINS: u32 = 3;

/// Logits that one unit of mean distance costs in [`Strategy::VerifierMedoid`].
///
/// Set before any episode was run, so no result has shaped it; to be changed on tuning seeds only.
pub const MEDOID_WEIGHT_LOGITS: f64 = 4.0;

/// Bins between the lowest and the highest action token: the unit of the distance between two candidates.
const BINS_SPAN: f64 = 255.0;

/// Continuous action dimensions; the seventh is the gripper, of which only the side counts.
const CONTINUOUS: usize = 6;

/// A rule that picks the candidate to execute.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Strategy {
    /// The most likely token at every place; one candidate.
    Greedy,
    /// One candidate drawn at the temperature.
    Sample,
    /// Self-consistency: the candidate that most candidates agree with (see [`MAJORITY_TOLERANCE_BINS`]).
    Majority,
    /// The candidate with the smallest summed distance to the others.
    Medoid,
    /// The highest verifier score.
    Verifier,
    /// The lowest verifier score: the control that shows whether the score means anything.
    Worst,
    /// The highest logit less [`MEDOID_WEIGHT_LOGITS`] times the mean distance to the other candidates.
    ///
    /// Logits are compared unstandardised on purpose: where the verifier sees no difference the medoid decides, and a
    /// confident verifier overrules agreement.
    VerifierMedoid,
    /// The candidate nearest to the scripted expert's action: the bound on what choosing can reach, for evaluation only.
    Oracle,
}

impl Strategy {
    /// All strategies, in the order of every table.
    pub const ALL: [Strategy; 8] = [
        Strategy::Greedy,
        Strategy::Sample,
        Strategy::Majority,
        Strategy::Medoid,
        Strategy::Verifier,
        Strategy::Worst,
        Strategy::VerifierMedoid,
        Strategy::Oracle,
    ];

    /// The name on the command line, in records and in tables.
    pub fn name(self) -> &'static str {
        match self {
            Strategy::Greedy => "greedy",
            Strategy::Sample => "sample",
            Strategy::Majority => "majority",
            Strategy::Medoid => "medoid",
            Strategy::Verifier => "verifier",
            Strategy::Worst => "worst",
            Strategy::VerifierMedoid => "verifier+medoid",
            Strategy::Oracle => "oracle",
        }
    }

    /// How many candidates to propose when `requested` are asked for: greedy and one sample need a single one.
    pub fn candidates(self, requested: usize) -> usize {
        match self {
            Strategy::Greedy | Strategy::Sample => 1,
            _ => requested,
        }
    }

    /// The sampling temperature when `requested` is asked for: greedy is temperature 0.
    pub fn temperature(self, requested: f32) -> f32 {
        match self {
            Strategy::Greedy => 0.0,
            _ => requested,
        }
    }

    /// Whether [`Decision::logits`] must be there.
    pub fn needs_verifier(self) -> bool {
        matches!(self, Strategy::Verifier | Strategy::Worst | Strategy::VerifierMedoid)
    }

    /// Whether [`Decision::expert_action`] must be there.
    pub fn needs_expert(self) -> bool {
        self == Strategy::Oracle
    }

    /// The index of the candidate to execute, or `None` when no candidate is well formed.
    ///
    /// Panics when the decision lacks what [`needs_verifier`](Self::needs_verifier) or
    /// [`needs_expert`](Self::needs_expert) asks for, or holds a number that is not finite: both are bugs of the caller.
    pub fn choose(self, decision: &Decision<'_>) -> Option<usize> {
        let candidates = decision.candidates;
        match self {
            Strategy::Greedy | Strategy::Sample => candidates.first()?.as_ref().map(|_| 0),
            Strategy::Majority => largest(candidates, |index, own| votes(candidates, index, own)),
            Strategy::Medoid => {
                largest(candidates, |index, own| -distance_mean(candidates, index, own))
            }
            Strategy::Verifier => largest(candidates, |index, _| decision.logit(index)),
            Strategy::Worst => largest(candidates, |index, _| -decision.logit(index)),
            Strategy::VerifierMedoid => largest(candidates, |index, own| {
                decision.logit(index) - MEDOID_WEIGHT_LOGITS * distance_mean(candidates, index, own)
            }),
            Strategy::Oracle => {
                let expert =
                    decision.expert_action.expect("the oracle is given the expert's action");
                largest(candidates, |_, own| {
                    -expert_distance(&own.action, expert, decision.action_scale)
                })
            }
        }
    }
}

impl fmt::Display for Strategy {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.pad(self.name())
    }
}

impl FromStr for Strategy {
    type Err = UnknownStrategy;

    fn from_str(text: &str) -> Result<Strategy, UnknownStrategy> {
        let found = Strategy::ALL.into_iter().find(|strategy| strategy.name() == text);
        found.ok_or_else(|| UnknownStrategy { name: text.to_owned() })
    }
}

/// A strategy's name that none has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownStrategy {
    name: String,
}

impl fmt::Display for UnknownStrategy {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = Strategy::ALL.map(Strategy::name).join(", ");
        write!(formatter, "strategy: expected one of {names}, got {:?}", self.name)
    }
}

impl std::error::Error for UnknownStrategy {}

/// What a well-formed candidate would do; the only part of a candidate that agreement and the oracle look at.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CandidateAction {
    /// Token ids of the seven action bins; neighbouring ids are neighbouring bins.
    pub tokens: [u32; 7],
    /// Metres, rotation vector in radians, gripper +1 open or -1 closed; base frame.
    pub action: [f32; 7],
}

/// All that a strategy may look at in one control step.
#[derive(Clone, Copy, Debug)]
pub struct Decision<'a> {
    /// One entry per candidate; `None` is a malformed one.
    pub candidates: &'a [Option<CandidateAction>],
    /// The verifier's logit of each candidate, as [`crate::verifier::Verifier::logits`] gives them. Logits, not
    /// probabilities: probabilities near 1 are equal in 32 bits long before the logits are.
    pub logits: Option<&'a [f32]>,
    /// The scripted expert's action at this state, in the units of [`CandidateAction::action`].
    pub expert_action: Option<&'a [f32; 7]>,
    /// What counts as one unit of each action dimension: the model's q99 - q01, and 2 for the gripper.
    pub action_scale: &'a [f32; 7],
}

impl Decision<'_> {
    fn logit(&self, index: usize) -> f64 {
        let logits = self.logits.expect("a strategy that needs the verifier is given its logits");
        assert_eq!(logits.len(), self.candidates.len(), "one logit per candidate");
        f64::from(logits[index])
    }
}

/// The first index with the largest value among the well-formed candidates.
fn largest(
    candidates: &[Option<CandidateAction>],
    value: impl Fn(usize, &CandidateAction) -> f64,
) -> Option<usize> {
    let mut best: Option<(usize, f64)> = None;
    for (index, candidate) in candidates.iter().enumerate() {
        let Some(candidate) = candidate else { continue };
        let value = value(index, candidate);
        assert!(value.is_finite(), "the value of candidate {index} is finite, got {value}");
        if best.is_none_or(|(_, best_value)| value > best_value) {
            best = Some((index, value));
        }
    }
    best.map(|(index, _)| index)
}

/// How many other candidates agree with this one.
fn votes(candidates: &[Option<CandidateAction>], index: usize, own: &CandidateAction) -> f64 {
    others(candidates, index).filter(|other| agree(own, other)).count() as f64
}

fn agree(a: &CandidateAction, b: &CandidateAction) -> bool {
    let near = a.tokens.iter().zip(&b.tokens).take(CONTINUOUS);
    same_gripper(a, b) && near.into_iter().all(|(a, b)| a.abs_diff(*b) <= MAJORITY_TOLERANCE_BINS)
}

/// The mean distance to the other well-formed candidates; 0 when there is none.
///
/// Ranking by the mean is ranking by the sum, and the mean keeps its meaning when some candidates are malformed.
pub(crate) fn distance_mean(
    candidates: &[Option<CandidateAction>],
    index: usize,
    own: &CandidateAction,
) -> f64 {
    let (sum, count) = others(candidates, index).fold((0.0, 0_u32), |(sum, count), other| {
        (sum + candidate_distance(own, other), count + 1)
    });
    sum / f64::from(count.max(1))
}

/// Summed differences of the six continuous bins, each as a part of the whole range, plus 1 for the other gripper side.
fn candidate_distance(a: &CandidateAction, b: &CandidateAction) -> f64 {
    let tokens = a.tokens.iter().zip(&b.tokens).take(CONTINUOUS);
    let bins: u32 = tokens.map(|(a, b)| a.abs_diff(*b)).sum();
    f64::from(bins) / BINS_SPAN + if same_gripper(a, b) { 0.0 } else { 1.0 }
}

fn same_gripper(a: &CandidateAction, b: &CandidateAction) -> bool {
    (a.action[CONTINUOUS] > 0.0) == (b.action[CONTINUOUS] > 0.0)
}

fn others(
    candidates: &[Option<CandidateAction>],
    index: usize,
) -> impl Iterator<Item = &CandidateAction> {
    candidates
        .iter()
        .enumerate()
        .filter(move |(other, _)| *other != index)
        .filter_map(|(_, candidate)| candidate.as_ref())
}

/// Euclidean distance in units of the action scale; a dimension without range cannot tell candidates apart and is left out.
fn expert_distance(action: &[f32; 7], expert: &[f32; 7], scale: &[f32; 7]) -> f64 {
    let squares = action.iter().zip(expert).zip(scale).filter(|(_, scale)| **scale > 0.0);
    let squares =
        squares.map(|((action, expert), scale)| f64::from((action - expert) / scale).powi(2));
    squares.sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCALE: [f32; 7] = [0.02, 0.02, 0.02, 0.1, 0.1, 0.1, 2.0];

    /// A candidate whose first bin is `bin`; the other five continuous bins are alike.
    fn at(bin: u32, gripper: f32) -> Option<CandidateAction> {
        let tokens = [bin, 500, 500, 500, 500, 500, if gripper > 0.0 { 599 } else { 400 }];
        Some(CandidateAction {
            tokens,
            action: [bin as f32 * 1e-4, 0.0, 0.0, 0.0, 0.0, 0.0, gripper],
        })
    }

    fn check(
        strategy: &str,
        candidates: &[Option<CandidateAction>],
        logits: &[f32],
        expected: Option<usize>,
    ) {
        let expert_action = [0.0502, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        let decision = Decision {
            candidates,
            logits: Some(logits),
            expert_action: Some(&expert_action),
            action_scale: &SCALE,
        };
        let strategy: Strategy = strategy.parse().expect("a known name");
        assert_eq!(strategy.choose(&decision), expected, "{strategy}");
    }

    #[test]
    fn every_strategy_has_its_own_choice() {
        // Candidates 1, 2 and 5 agree; 3 and 4 stand apart; 4 has the other gripper side.
        let candidates =
            [at(470, 1.0), at(510, 1.0), at(512, 1.0), at(560, 1.0), at(511, -1.0), at(507, 1.0)];
        let logits = [0.5, -0.5, 0.0, 1.5, -2.0, 0.4];
        check("greedy", &candidates, &logits, Some(0));
        check("sample", &candidates, &logits, Some(0));
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
        // One sample means one: a later candidate must not stand in for a malformed first one.
        check("sample", &[None, at(500, 1.0), None], &logits, None);
    }

    #[test]
    fn ties_go_to_the_first() {
        let candidates = [None, at(500, 1.0), at(500, 1.0), at(500, 1.0)];
        for strategy in &Strategy::ALL[2..] {
            check(strategy.name(), &candidates, &[1.0; 4], Some(1));
        }
        // Nobody agrees with anybody: the vote is a tie of all.
        check("majority", &[at(400, 1.0), at(500, 1.0), at(600, 1.0)], &[0.0; 3], Some(0));
    }

    #[test]
    fn majority_counts_votes_within_three_bins_on_the_same_gripper_side() {
        check("majority", &[at(500, 1.0), at(510, 1.0), at(513, 1.0)], &[0.0; 3], Some(1));
        check("majority", &[at(500, 1.0), at(510, 1.0), at(514, 1.0)], &[0.0; 3], Some(0));
        check("majority", &[at(500, 1.0), at(510, 1.0), at(510, -1.0)], &[0.0; 3], Some(0));
        // 503 is near to both of its neighbours, which are not near to each other.
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
        // The mean distances are 61.5/255 and 16.25/255: the weight's own turning point, from both sides.
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
        let with = |action| Some(CandidateAction { tokens: [500; 7], action });
        check("oracle", &[with(far_in_metres), with(far_in_radians)], &[0.0; 2], Some(1));
        let distance =
            expert_distance(&far_in_metres, &[0.0502, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0], &SCALE);
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
            "strategy: expected one of greedy, sample, majority, medoid, verifier, worst, verifier+medoid, oracle, got \"Verifier\"",
        );
        assert_eq!(Strategy::Sample.candidates(5), 1);
        assert_eq!(Strategy::Medoid.candidates(5), 5);
        assert_eq!(Strategy::Greedy.temperature(1.0), 0.0);
        assert_eq!(Strategy::Worst.temperature(0.7), 0.7);
    }

    #[test]
    #[should_panic(expected = "is finite")]
    fn a_score_that_is_no_number_is_a_bug() {
        check("verifier", &[at(500, 1.0)], &[f32::NAN], Some(0));
    }
}
