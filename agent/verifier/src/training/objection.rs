//! Which episodes must not teach a verifier, and why.

use std::fmt;

use protocol::EpisodeOutcome;

use decision::Strategy;
use store::plan::SeedRange;

/// Why an episode must not teach the verifier of a policy.
#[derive(Clone, Debug, PartialEq)]
pub enum Objection {
    /// Its layout is one of those kept for evaluation.
    Layout(u32),
    /// Its scene is not one of those for collection.
    Seed(u64),
    /// Its candidates were not sampled.
    Temperature(f32),
    /// Its actions were not chosen from what the policy alone knows; or nobody knows how.
    Strategy(String),
    /// Its hidden states mean something else to this policy.
    Policy(String),
    /// It never acted, so it has no outcome.
    NoSteps,
}

impl Objection {
    /// The reason in few words, the same for all episodes that it holds for.
    pub fn reason(&self) -> &'static str {
        match self {
            Objection::Layout(_) => "layout of the evaluation",
            Objection::Seed(_) => "seed outside of the collection range",
            Objection::Temperature(_) => "greedy",
            Objection::Strategy(_) => "chosen by the expert",
            Objection::Policy(_) => "another policy",
            Objection::NoSteps => "no outcome",
        }
    }
}

impl fmt::Display for Objection {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let first = SeedRange::Collection.first();
        match self {
            Objection::Layout(layout) => {
                write!(formatter, "expected a random layout, got layout {layout}")
            }
            Objection::Seed(seed) => {
                write!(
                    formatter,
                    "expected a seed of the collection range from {first} on, got {seed}"
                )
            }
            Objection::Temperature(temperature) => {
                write!(formatter, "expected a temperature above 0, got {temperature}")
            }
            Objection::Strategy(strategy) => {
                write!(
                    formatter,
                    "expected a strategy that does without the expert, got {strategy}"
                )
            }
            Objection::Policy(policy) => {
                write!(
                    formatter,
                    "expected hidden states of the policy to train for, got policy {policy}"
                )
            }
            Objection::NoSteps => {
                write!(formatter, "expected an outcome, got an episode without steps")
            }
        }
    }
}

impl std::error::Error for Objection {}

/// Whether an episode may teach the verifier of the policy with this digest.
pub fn object(outcome: &EpisodeOutcome, policy: &str) -> Option<Objection> {
    let with_expert = |strategy: &str| strategy.parse().map_or(true, Strategy::needs_expert);
    if let Some(layout) = outcome.layout {
        Some(Objection::Layout(layout))
    } else if !SeedRange::Collection.contains(outcome.seed) {
        Some(Objection::Seed(outcome.seed))
    } else if outcome.temperature <= 0.0 {
        Some(Objection::Temperature(outcome.temperature))
    } else if with_expert(&outcome.strategy) {
        Some(Objection::Strategy(outcome.strategy.clone()))
    } else if outcome.policy != policy {
        Some(Objection::Policy(outcome.policy.clone()))
    } else if outcome.steps == 0 {
        Some(Objection::NoSteps)
    } else {
        None
    }
}
