//! Strategies: how one of several candidates is selected.
//!
//! A strategy uses plain data only, so that its choice can be repeated from a record. It never
//! selects a malformed candidate; among equally good candidates it selects the first. If no
//! candidate can be selected the result is `None` and the robot holds still.

use std::fmt;
use std::str::FromStr;

use crate::{Action, ActionSpace, CandidateAction};

/// Two candidates vote for each other in [`Strategy::Majority`] if no continuous action token
/// differs by more than this number of bins.
///
/// Exact agreement of seven tokens is rare with 256 bins per dimension: a strict vote would be
/// equivalent to a single sample.
pub const MAJORITY_TOLERANCE_BINS: u32 = 3;

/// Weight of one unit of mean distance in [`Strategy::VerifierMedoid`], in logits.
///
/// It was fixed before any episode was run, so that no result has influenced it. Change it on
/// tuning seeds only.
pub const MEDOID_WEIGHT_LOGITS: f64 = 4.0;

/// Bins between the lowest and the highest action token; the unit of the distance between two
/// candidates.
const BINS_SPAN: f64 = 255.0;

/// A rule that selects the candidate to execute.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Strategy {
    /// The most likely token at every position; one candidate.
    Greedy,
    /// A single sample (N = 1) at the temperature.
    Sample,
    /// The first well-formed candidate: shows what several attempts gain without any comparison.
    FirstWellFormed,
    /// Self-consistency: the candidate that agrees with the most others (see
    /// [`MAJORITY_TOLERANCE_BINS`]).
    Majority,
    /// The candidate with the smallest summed distance to the others.
    Medoid,
    /// The candidate with the highest verifier score.
    Verifier,
    /// The candidate with the lowest verifier score: a control for whether the score is
    /// informative.
    Worst,
    /// The candidate with the highest logit minus [`MEDOID_WEIGHT_LOGITS`] times its mean distance
    /// to the others.
    ///
    /// Logits are deliberately not standardised: if the verifier's logits are equal the medoid
    /// decides, and a confident verifier overrules agreement.
    VerifierMedoid,
    /// The candidate nearest to the scripted expert's action: an upper bound of what selection can
    /// reach. For evaluation only.
    Oracle,
}

impl Strategy {
    /// All strategies, in the order of every table.
    pub const ALL: [Strategy; 9] = [
        Strategy::Greedy,
        Strategy::Sample,
        Strategy::FirstWellFormed,
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
            Strategy::FirstWellFormed => "first-well-formed",
            Strategy::Majority => "majority",
            Strategy::Medoid => "medoid",
            Strategy::Verifier => "verifier",
            Strategy::Worst => "worst",
            Strategy::VerifierMedoid => "verifier+medoid",
            Strategy::Oracle => "oracle",
        }
    }

    /// What it executes, in one line for help and lists.
    pub fn meaning(self) -> &'static str {
        match self {
            Strategy::Greedy => "the most likely token at every position; one candidate",
            Strategy::Sample => "the first sampled candidate: the baseline",
            Strategy::FirstWellFormed => "the first of N candidates that holds a valid action",
            Strategy::Majority => "the action that most candidates agree with (self-consistency)",
            Strategy::Medoid => "the candidate nearest to all others",
            Strategy::Verifier => "the highest verifier score: ReVer",
            Strategy::Worst => "the lowest verifier score: a control",
            Strategy::VerifierMedoid => "verifier score minus the distance to the other candidates",
            Strategy::Oracle => "the candidate nearest to the scripted expert: an upper bound",
        }
    }

    /// Number of candidates to propose if `requested` are requested: greedy and single sample need
    /// one.
    pub fn candidates(self, requested: usize) -> usize {
        match self {
            Strategy::Greedy | Strategy::Sample => 1,
            _ => requested,
        }
    }

    /// Sampling temperature if `requested` is requested: greedy is temperature 0.
    pub fn temperature(self, requested: f32) -> f32 {
        match self {
            Strategy::Greedy => 0.0,
            _ => requested,
        }
    }

    /// Whether the strategy compares the well-formed candidates. The scores of selected candidates
    /// are then biased by the selection.
    pub fn compares_candidates(self) -> bool {
        !matches!(self, Strategy::Greedy | Strategy::Sample | Strategy::FirstWellFormed)
    }

    /// Whether [`Alternatives::logits`] is required.
    pub fn needs_verifier(self) -> bool {
        matches!(self, Strategy::Verifier | Strategy::Worst | Strategy::VerifierMedoid)
    }

    /// Whether [`Alternatives::expert_action`] is required.
    pub fn needs_expert(self) -> bool {
        self == Strategy::Oracle
    }

    /// The index of the candidate to execute, or `None` if no candidate is well formed.
    ///
    /// Panics if the input lacks what [`needs_verifier`](Self::needs_verifier) or
    /// [`needs_expert`](Self::needs_expert) requires, or contains a number that is not finite: both
    /// are bugs of the caller.
    pub fn choose(self, alternatives: &Alternatives<'_>) -> Option<usize> {
        let (candidates, space) = (alternatives.candidates, alternatives.action_space);
        match self {
            Strategy::Greedy | Strategy::Sample => candidates.first()?.as_ref().map(|_| 0),
            Strategy::FirstWellFormed => candidates.iter().position(Option::is_some),
            Strategy::Majority => largest(candidates, |index, own| votes(alternatives, index, own)),
            Strategy::Medoid => {
                largest(candidates, |index, own| -distance_mean(candidates, index, own, space))
            }
            Strategy::Verifier => largest(candidates, |index, _| alternatives.logit(index)),
            Strategy::Worst => largest(candidates, |index, _| -alternatives.logit(index)),
            Strategy::VerifierMedoid => largest(candidates, |index, own| {
                alternatives.logit(index)
                    - MEDOID_WEIGHT_LOGITS * distance_mean(candidates, index, own, space)
            }),
            Strategy::Oracle => {
                let expert =
                    alternatives.expert_action.expect("the oracle requires the expert's action");
                largest(candidates, |_, own| {
                    -expert_distance(own.actions.first(), expert, &space.scale)
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

/// The name of a strategy that does not exist.
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

/// The input of a strategy in one decision.
#[derive(Clone, Copy, Debug)]
pub struct Alternatives<'a> {
    /// One entry per candidate; `None` for a malformed one.
    pub candidates: &'a [Option<CandidateAction<'a>>],
    /// The scorer's logit of each candidate, see [`crate::Scorer::score`].
    pub logits: Option<&'a [f32]>,
    /// The scripted expert's action in this state, in the units of the candidates' actions.
    pub expert_action: Option<&'a [f32]>,
    /// How to compare the candidates' actions.
    pub action_space: &'a ActionSpace,
}

impl Alternatives<'_> {
    fn logit(&self, index: usize) -> f64 {
        let logits = self.logits.expect("a strategy that needs a verifier requires logits");
        assert_eq!(logits.len(), self.candidates.len(), "one logit per candidate");
        f64::from(logits[index])
    }
}

/// The first index with the largest value among the well-formed candidates.
fn largest(
    candidates: &[Option<CandidateAction<'_>>],
    value: impl Fn(usize, &CandidateAction<'_>) -> f64,
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

/// Number of other candidates that agree with this one.
fn votes(alternatives: &Alternatives<'_>, index: usize, own: &CandidateAction<'_>) -> f64 {
    let space = alternatives.action_space;
    others(alternatives.candidates, index).filter(|other| agree(own, other, space)).count() as f64
}

fn agree(a: &CandidateAction<'_>, b: &CandidateAction<'_>, space: &ActionSpace) -> bool {
    differences(a, b, space).into_iter().all(|difference| match difference {
        Difference::Bins(bins) => bins <= f64::from(MAJORITY_TOLERANCE_BINS),
        Difference::Gripper(is_other_side) => !is_other_side,
    })
}

/// The mean distance to the other well-formed candidates; 0 if there are none.
///
/// The mean ranks candidates as the sum does, and stays comparable if some candidates are
/// malformed.
pub fn distance_mean(
    candidates: &[Option<CandidateAction<'_>>],
    index: usize,
    own: &CandidateAction<'_>,
    space: &ActionSpace,
) -> f64 {
    let (sum, count) = others(candidates, index).fold((0.0, 0_u32), |(sum, count), other| {
        (sum + candidate_distance(own, other, space), count + 1)
    });
    sum / f64::from(count.max(1))
}

/// The difference between two candidates in one dimension of one action.
enum Difference {
    /// For a continuous dimension, in bins; [`BINS_SPAN`] is the whole range.
    Bins(f64),
    /// For the gripper: whether one opens and the other closes.
    Gripper(bool),
}

/// The difference in each dimension: in bins if both candidates have action tokens, otherwise from
/// the numbers and their scale.
fn differences(
    a: &CandidateAction<'_>,
    b: &CandidateAction<'_>,
    space: &ActionSpace,
) -> Vec<Difference> {
    let numbers = |actions: &[Action]| actions.iter().flatten().copied().collect::<Vec<f32>>();
    let (a_numbers, b_numbers) = (numbers(a.actions.actions()), numbers(b.actions.actions()));
    let has_tokens = a.tokens.len() == a_numbers.len() && b.tokens.len() == b_numbers.len();
    let length = space.length().max(1);
    let difference = |(index, (a_number, b_number)): (usize, (&f32, &f32))| {
        let dimension = index % length;
        if space.gripper == Some(dimension) {
            return Difference::Gripper((*a_number > 0.0) != (*b_number > 0.0));
        }
        if has_tokens {
            return Difference::Bins(f64::from(a.tokens[index].abs_diff(b.tokens[index])));
        }
        let scale = f64::from(space.scale.get(dimension).copied().unwrap_or(0.0));
        let apart = (f64::from(*a_number) - f64::from(*b_number)).abs();
        Difference::Bins(if scale > 0.0 { apart / scale * BINS_SPAN } else { 0.0 })
    };
    a_numbers.iter().zip(&b_numbers).enumerate().map(difference).collect()
}

/// Sum over the continuous dimensions of the difference relative to the whole range, plus 1 for
/// each opposite gripper command.
fn candidate_distance(
    a: &CandidateAction<'_>,
    b: &CandidateAction<'_>,
    space: &ActionSpace,
) -> f64 {
    let (mut bins, mut sides) = (0.0, 0.0);
    for difference in differences(a, b, space) {
        match difference {
            Difference::Bins(apart) => bins += apart,
            Difference::Gripper(is_other_side) => sides += f64::from(u8::from(is_other_side)),
        }
    }
    bins / BINS_SPAN + sides
}

fn others<'a, 'b>(
    candidates: &'a [Option<CandidateAction<'b>>],
    index: usize,
) -> impl Iterator<Item = &'a CandidateAction<'b>> {
    candidates
        .iter()
        .enumerate()
        .filter(move |(other, _)| *other != index)
        .filter_map(|(_, candidate)| candidate.as_ref())
}

/// Euclidean distance of the first action in units of the action scale. Dimensions without a range
/// are ignored.
fn expert_distance(action: &[f32], expert: &[f32], scale: &[f32]) -> f64 {
    let squares = action.iter().zip(expert).zip(scale).filter(|(_, scale)| **scale > 0.0);
    let squares =
        squares.map(|((action, expert), scale)| f64::from((action - expert) / scale).powi(2));
    squares.sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests;
