//! Planned episodes, and what their seeds may be used for.

use decision::TaskId;

/// Seeds of one range; no two ranges share a seed.
pub const SEEDS_PER_RANGE: u64 = 1_000_000_000;

/// What a seed may be used for. Demonstrations, collected labels and evaluation never share an initial layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SeedRange {
    /// The expert's demonstrations that generators are trained on.
    Demonstrations,
    /// Rollouts that verifiers are trained on.
    Collection,
    /// Choosing between settings.
    Tuning,
    /// Held out: results only.
    Evaluation,
}

impl SeedRange {
    /// The range's first seed.
    pub fn first(self) -> u64 {
        self as u64 * SEEDS_PER_RANGE
    }

    /// Whether a seed lies in this range.
    pub fn contains(self, seed: u64) -> bool {
        (self.first()..self.first() + SEEDS_PER_RANGE).contains(&seed)
    }
}

/// A task that servers offer, in one variant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OfferedTask {
    /// The task and its variant.
    pub id: TaskId,
    /// How many fixed initial layouts it has.
    pub layouts: u32,
    /// Control steps after which an episode is truncated.
    pub steps_max: u32,
}

/// One episode to be run, not yet tied to a setting.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EpisodePlan {
    /// The task and its variant.
    pub task: TaskId,
    /// One of the task's fixed initial layouts, or none for a random one.
    pub layout: Option<u32>,
    /// Number within task and variant.
    pub episode: u32,
    /// The environment's seed.
    pub seed: u64,
    /// The policy's seed.
    pub sampling_seed: u64,
}
