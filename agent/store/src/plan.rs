//! Planned episodes and the use of their seeds.

use decision::TaskId;

/// Number of seeds per range; ranges are disjoint.
pub const SEEDS_PER_RANGE: u64 = 1_000_000_000;

/// The use of a seed. Demonstrations, collected labels and evaluation never share an initial
/// layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SeedRange {
    /// The expert's demonstrations, on which generators are trained.
    Demonstrations,
    /// Rollouts on which verifiers are trained.
    Collection,
    /// Comparing settings.
    Tuning,
    /// Held out for results only.
    Evaluation,
}

impl SeedRange {
    /// The first seed of the range.
    pub fn first(self) -> u64 {
        self as u64 * SEEDS_PER_RANGE
    }

    /// Whether the range contains a seed.
    pub fn contains(self, seed: u64) -> bool {
        (self.first()..self.first() + SEEDS_PER_RANGE).contains(&seed)
    }
}

/// A task in one variant that servers offer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OfferedTask {
    /// The task and its variant.
    pub id: TaskId,
    /// Number of its fixed initial layouts.
    pub layouts: u32,
    /// Control steps after which an episode is truncated.
    pub steps_max: u32,
}

/// An episode to run, not yet combined with a setting.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EpisodePlan {
    /// The task and its variant.
    pub task: TaskId,
    /// Number of the task's fixed initial layout; `None` for a random one.
    pub layout: Option<u32>,
    /// Number within task and variant.
    pub episode: u32,
    /// Seed of the environment.
    pub seed: u64,
    /// Seed of the policy's sampling.
    pub sampling_seed: u64,
}
