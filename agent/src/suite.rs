//! What a run consists of: episodes and the arms that each of them is run with.
//!
//! Seeds come from what an episode is, never from which worker runs it or when, so that a resumed, a distributed and an
//! uninterrupted run have the same episodes. The policy's seed does not depend on the strategy: arms of one episode start
//! from the same scene with the same random numbers, which is what makes their differences paired.

use std::fmt;

use clap::ValueEnum;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::strategy::Strategy;

/// SIMPLER's WidowX Bridge tasks, in the order of every table.
pub const TASKS: [&str; 4] = [
    "widowx_spoon_on_towel",
    "widowx_carrot_on_plate",
    "widowx_stack_cube",
    "widowx_put_eggplant_in_basket",
];

/// The variant that a task has unless another is asked for.
pub const VARIANT_DEFAULT: &str = "default";

/// SIMPLER's layouts of each task.
pub const LAYOUTS: u32 = 24;

/// Seeds of one range; no two ranges share a seed.
const SEEDS_PER_RANGE: u64 = 1_000_000_000;

/// What a seed may be used for. Demonstrations, collected labels and evaluation never share a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SeedRange {
    /// The expert's demonstrations that the generator learns from.
    Demonstrations,
    /// Rollouts that the verifier learns from.
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

/// Where the objects of each episode stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layouts {
    /// The 24 layouts, over and over.
    Grid,
    /// Drawn from each episode's seed.
    Random,
}

/// Which episodes to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Suite {
    /// Task names.
    pub tasks: Vec<String>,
    /// Episodes of each task.
    pub episodes: u32,
    /// Where objects stand.
    pub layouts: Layouts,
    /// Where seeds come from.
    pub range: SeedRange,
    /// Another number gives other layouts and other samples.
    pub seed: u64,
}

impl Suite {
    /// The episodes, task by task within each number, so that a partial run covers all tasks alike.
    pub fn episodes(&self) -> Vec<EpisodePlan> {
        let numbers = 0..self.episodes;
        numbers
            .flat_map(|episode| self.tasks.iter().map(move |task| self.episode(task, episode)))
            .collect()
    }

    fn episode(&self, task: &str, episode: u32) -> EpisodePlan {
        let place = mixed("place", task, episode, self.seed);
        EpisodePlan {
            task: task.to_owned(),
            variant: VARIANT_DEFAULT.to_owned(),
            layout: (self.layouts == Layouts::Grid)
                .then_some(episode % LAYOUTS),
            episode,
            seed: self.range.first() + place % SEEDS_PER_RANGE,
            // Every reader of a record, JavaScript included, must hold this number exactly.
            sampling_seed: mixed("sample", task, episode, self.seed) % (1 << 53),
        }
    }
}

/// One episode of a suite, not yet tied to an arm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EpisodePlan {
    /// The task's name.
    pub task: String,
    /// The task's variant.
    pub variant: String,
    /// One of the 24 layouts, or none for a random one.
    pub layout: Option<u32>,
    /// Number within the task.
    pub episode: u32,
    /// The world's seed.
    pub seed: u64,
    /// The policy's seed.
    pub sampling_seed: u64,
}

/// How the candidates of an episode are drawn and chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arm {
    /// How to choose.
    pub strategy: Strategy,
    /// Candidates per step.
    pub candidates: u32,
    /// Sampling temperature.
    pub temperature: f32,
}

impl Arm {
    /// What an arm asked for comes to: greedy has temperature 0, and whoever chooses from one candidate takes one sample.
    pub fn new(strategy: Strategy, candidates: u32, temperature: f32) -> Arm {
        let drawn = strategy.candidates(candidates as usize) as u32;
        let strategy =
            if drawn == 1 && strategy != Strategy::Greedy { Strategy::Sample } else { strategy };
        Arm { strategy, candidates: drawn, temperature: strategy.temperature(temperature) }
    }

    /// All different arms of the given strategies, temperatures and numbers of candidates, in that order.
    pub fn all(strategies: &[Strategy], temperatures: &[f32], candidates: &[u32]) -> Vec<Arm> {
        let mut arms: Vec<Arm> = Vec::new();
        for strategy in strategies {
            for temperature in temperatures {
                for count in candidates {
                    let arm = Arm::new(*strategy, *count, *temperature);
                    if !arms.contains(&arm) {
                        arms.push(arm);
                    }
                }
            }
        }
        arms
    }
}

impl fmt::Display for Arm {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.strategy {
            Strategy::Greedy => write!(formatter, "greedy"),
            Strategy::Sample if self.candidates == 1 => {
                write!(formatter, "sample T={}", self.temperature)
            }
            strategy => {
                write!(formatter, "{strategy} N={} T={}", self.candidates, self.temperature)
            }
        }
    }
}

/// The policy's seed at one control step: every step draws from its own stream.
pub fn step_seed(sampling_seed: u64, step: u32) -> u64 {
    first_eight_bytes(
        Sha256::new().chain_update(sampling_seed.to_le_bytes()).chain_update(step.to_le_bytes()),
    )
}

/// A number that is the same on every machine and in every version of this program.
fn mixed(purpose: &str, task: &str, episode: u32, seed: u64) -> u64 {
    let text = format!("{purpose}/{task}/{VARIANT_DEFAULT}/{episode}/{seed}");
    first_eight_bytes(Sha256::new().chain_update(text))
}

fn first_eight_bytes(hash: Sha256) -> u64 {
    let digest = hash.finalize();
    let mut bytes = [0; 8];
    bytes.copy_from_slice(&digest[..8]);
    u64::from_le_bytes(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn suite(layouts: Layouts, seed: u64) -> Suite {
        let tasks = TASKS.map(str::to_owned).to_vec();
        Suite { tasks, episodes: 30, layouts, range: SeedRange::Evaluation, seed }
    }

    #[test]
    fn an_episode_is_the_same_in_every_suite_that_has_it() {
        let all = suite(Layouts::Random, 5).episodes();
        let mut few = suite(Layouts::Random, 5);
        few.tasks = vec![TASKS[2].to_owned()];
        few.episodes = 7;
        for plan in few.episodes() {
            assert!(all.contains(&plan), "{plan:?}");
        }
    }

    #[test]
    fn seeds_differ_and_stay_in_their_range() {
        let mut plans = suite(Layouts::Random, 0).episodes();
        plans.extend(suite(Layouts::Random, 1).episodes());
        assert!(plans.iter().all(|plan| SeedRange::Evaluation.contains(plan.seed)));
        assert!(plans.iter().all(|plan| !SeedRange::Collection.contains(plan.seed)));
        assert!(plans.iter().all(|plan| plan.sampling_seed < 1 << 53));
        for seeds in [|plan: &EpisodePlan| plan.seed, |plan: &EpisodePlan| plan.sampling_seed] {
            let different: std::collections::BTreeSet<u64> = plans.iter().map(seeds).collect();
            assert_eq!(different.len(), plans.len());
        }
    }

    #[test]
    fn seeds_never_change_between_versions() {
        let plan = &suite(Layouts::Random, 0).episodes()[0];
        assert_eq!((plan.seed, plan.sampling_seed), SEEDS_OF_THE_FIRST_EPISODE);
        assert_ne!(step_seed(1, 0), step_seed(1, 1));
        assert_ne!(step_seed(1, 0), step_seed(2, 0));
    }

    /// Computed independently: the first eight bytes, little endian, of
    /// `sha256("place/widowx_spoon_on_towel/default/0/0")` and of the same with `sample`.
    const SEEDS_OF_THE_FIRST_EPISODE: (u64, u64) = (3_977_631_995, 8_353_930_603_780_422);

    #[test]
    fn the_grid_has_every_layout_once_before_any_comes_again() {
        let plans = suite(Layouts::Grid, 0).episodes();
        let of_task = plans.iter().filter(|plan| plan.task == TASKS[1]);
        let layouts: Vec<Option<u32>> = of_task.map(|plan| plan.layout).collect();
        assert_eq!(layouts[..24], (0..24).map(Some).collect::<Vec<_>>());
        assert_eq!(layouts[24..], (0..6).map(Some).collect::<Vec<_>>());
    }

    #[test]
    fn arms_that_come_to_the_same_are_run_once() {
        let arms = Arm::all(
            &[Strategy::Greedy, Strategy::Sample, Strategy::Verifier],
            &[1.0, 0.7],
            &[1, 2, 5],
        );
        let drawn = Arm { strategy: Strategy::Sample, candidates: 5, temperature: 1.0 };
        assert_eq!(drawn.to_string(), "sample N=5 T=1", "as collected, to be compared");
        let names: Vec<String> = arms.iter().map(Arm::to_string).collect();
        let expected = [
            "greedy",
            "sample T=1",
            "sample T=0.7",
            "verifier N=2 T=1",
            "verifier N=5 T=1",
            "verifier N=2 T=0.7",
            "verifier N=5 T=0.7",
        ];
        assert_eq!(names, expected);
    }
}
