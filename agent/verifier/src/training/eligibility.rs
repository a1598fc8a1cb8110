//! Eligibility of episodes for verifier training.

use std::fmt;

use decision::Strategy;
use protocol::EpisodeOutcome;
use store::plan::SeedRange;
use store::record::EpisodeRecord;

/// Why an episode is not used to train the verifier of a policy.
#[derive(Clone, Debug, PartialEq)]
pub enum ExclusionReason {
    /// Its layout is one of those kept for evaluation.
    Layout(u32),
    /// Its initial layout is not one of those for collection.
    Seed(u64),
    /// Its candidates were not sampled.
    Temperature(f32),
    /// Its executed candidates were selected, so that their hidden states are not those of drawn candidates.
    Selected(String),
    /// Its hidden states mean something else to this policy.
    Policy(String),
    /// It has no steps, so it has no outcome.
    NoSteps,
    /// The policy never acted, so the outcome is not its own.
    NeverActed,
}

impl ExclusionReason {
    /// The reason in few words, the same for all episodes that it holds for.
    pub fn summary(&self) -> &'static str {
        match self {
            ExclusionReason::Layout(_) => "evaluation layout",
            ExclusionReason::Seed(_) => "seed outside the collection range",
            ExclusionReason::Temperature(_) => "greedy",
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
                "expected a seed of the collection range from {first} on, got {seed}"
            ),
            ExclusionReason::Temperature(temperature) => {
                write!(formatter, "expected a temperature above 0, got {temperature}")
            }
            ExclusionReason::Selected(strategy) => write!(
                formatter,
                "expected executed candidates that were drawn (strategy {}), got strategy {strategy}",
                Strategy::Sample
            ),
            ExclusionReason::Policy(policy) => write!(
                formatter,
                "expected hidden states of the policy to train for, got policy {policy}"
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

/// Whether the executed candidates of a strategy are draws: chosen by nothing but their place and their form.
fn is_drawn(strategy: &str) -> bool {
    matches!(strategy.parse(), Ok(Strategy::Sample | Strategy::FirstWellFormed))
}

/// What excludes an episode from training the verifier of the policy with this digest, as far as its label tells.
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

/// What excludes an episode, by its whole record.
pub fn exclude_record(record: &EpisodeRecord, policy: &str) -> Option<ExclusionReason> {
    exclude_label(&store::labels::outcome(record), policy)
        .or_else(|| (!record.has_outcome()).then_some(ExclusionReason::NeverActed))
}
