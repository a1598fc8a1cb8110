//! Eligibility of episodes for verifier training.

use std::fmt;

use decision::Strategy;
use protocol::EpisodeOutcome;
use store::plan::SeedRange;
use store::record::EpisodeRecord;

/// Why an episode is excluded from training the verifier of a policy.
#[derive(Clone, Debug, PartialEq)]
pub enum ExclusionReason {
    /// Its layout is reserved for evaluation.
    Layout(u32),
    /// Its seed is outside the collection range.
    Seed(u64),
    /// Its candidates were decoded greedily.
    Temperature(f32),
    /// Its executed candidates were selected, which biases their hidden states.
    Selected(String),
    /// Its hidden states are those of another policy.
    Policy(String),
    /// It has no steps and therefore no outcome.
    NoSteps,
    /// The policy never acted, so the outcome is not the policy's.
    NeverActed,
}

impl ExclusionReason {
    /// A short reason, the same for all episodes that it applies to.
    pub fn summary(&self) -> &'static str {
        match self {
            ExclusionReason::Layout(_) => "evaluation layout",
            ExclusionReason::Seed(_) => "seed outside the collection range",
            ExclusionReason::Temperature(_) => "greedy decoding",
            ExclusionReason::Selected(_) => "selected candidates",
            ExclusionReason::Policy(_) => "another policy",
            ExclusionReason::NoSteps => "no steps",
            ExclusionReason::NeverActed => "the policy never acted",
        }
    }
}

impl fmt::Display for ExclusionReason {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let first = SeedRange::Collection.first();
        match self {
            ExclusionReason::Layout(layout) => {
                write!(formatter, "expected a random initial layout, got layout {layout}")
            }
            ExclusionReason::Seed(seed) => write!(
                formatter,
                "expected a seed in the collection range (from {first}), got {seed}"
            ),
            ExclusionReason::Temperature(temperature) => {
                write!(formatter, "expected a temperature above 0, got {temperature}")
            }
            ExclusionReason::Selected(strategy) => write!(
                formatter,
                "expected an episode of strategy {}, got {strategy}; `rever collect` records them",
                Strategy::Sample
            ),
            ExclusionReason::Policy(policy) => write!(
                formatter,
                "expected hidden states of the verifier's policy, got those of policy {policy}"
            ),
            ExclusionReason::NoSteps => {
                write!(formatter, "expected an outcome, got an episode without steps")
            }
            ExclusionReason::NeverActed => write!(
                formatter,
                "expected at least one executed candidate, got an episode in which the robot held still"
            ),
        }
    }
}

impl std::error::Error for ExclusionReason {}

/// Whether a strategy executes sampled candidates without comparing them.
fn is_drawn(strategy: &str) -> bool {
    matches!(strategy.parse(), Ok(Strategy::Sample | Strategy::FirstWellFormed))
}

/// The reason that excludes an episode from training, as far as its label shows.
pub fn exclude_label(outcome: &EpisodeOutcome, policy: &str) -> Option<ExclusionReason> {
    if let Some(layout) = outcome.layout {
        Some(ExclusionReason::Layout(layout))
    } else if !SeedRange::Collection.contains(outcome.seed) {
        Some(ExclusionReason::Seed(outcome.seed))
    } else if outcome.temperature <= 0.0 {
        Some(ExclusionReason::Temperature(outcome.temperature))
    } else if !is_drawn(&outcome.strategy) {
        Some(ExclusionReason::Selected(outcome.strategy.clone()))
    } else if outcome.policy != policy {
        Some(ExclusionReason::Policy(outcome.policy.clone()))
    } else if outcome.steps == 0 {
        Some(ExclusionReason::NoSteps)
    } else {
        None
    }
}

/// The reason that excludes an episode from training, according to its record.
pub fn exclude_record(record: &EpisodeRecord, policy: &str) -> Option<ExclusionReason> {
    exclude_label(&store::labels::outcome(record), policy)
        .or_else(|| (!record.has_outcome()).then_some(ExclusionReason::NeverActed))
}
