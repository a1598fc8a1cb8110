//! Suites: which episodes an evaluation consists of.
//!
//! Seeds come from what an episode is, never from which worker runs it or when, so that a resumed, a distributed and an
//! uninterrupted run have the same episodes. The policy's seed does not depend on the strategy: all settings of one episode
//! start from the same initial layout with the same random numbers, which is what makes their differences paired.

use clap::ValueEnum;
use decision::TaskId;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use store::plan::{EpisodePlan, SEEDS_PER_RANGE, SeedRange};

/// Fixed initial layouts of each of SIMPLER's tasks.
pub const LAYOUTS: u32 = 24;

/// Where the objects of each episode start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layouts {
    /// The 24 fixed layouts, over and over.
    Grid,
    /// Drawn from each episode's seed.
    Random,
}

/// Which episodes to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Suite {
    /// Tasks, each in a variant.
    pub tasks: Vec<TaskId>,
    /// Episodes of each task.
    pub episodes: u32,
    /// Where objects start.
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

    fn episode(&self, task: &TaskId, episode: u32) -> EpisodePlan {
        let place = mixed("place", task, episode, self.seed);
        EpisodePlan {
            task: task.clone(),
            layout: (self.layouts == Layouts::Grid).then_some(episode % LAYOUTS),
            episode,
            seed: self.range.first() + place % SEEDS_PER_RANGE,
            // Every reader of a record, JavaScript included, must hold this number exactly.
            sampling_seed: mixed("sample", task, episode, self.seed) % (1 << 53),
        }
    }
}

/// A number that is the same on every machine and in every version of this program.
fn mixed(purpose: &str, id: &TaskId, episode: u32, seed: u64) -> u64 {
    let TaskId { task, variant } = id;
    let digest = Sha256::digest(format!("{purpose}/{task}/{variant}/{episode}/{seed}"));
    let mut bytes = [0; 8];
    bytes.copy_from_slice(&digest[..8]);
    u64::from_le_bytes(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    const TASKS: [&str; 4] = [
        "widowx_spoon_on_towel",
        "widowx_carrot_on_plate",
        "widowx_stack_cube",
        "widowx_put_eggplant_in_basket",
    ];

    fn suite(layouts: Layouts, seed: u64) -> Suite {
        let tasks = TASKS.map(TaskId::default_of).to_vec();
        Suite { tasks, episodes: 30, layouts, range: SeedRange::Evaluation, seed }
    }

    #[test]
    fn an_episode_is_the_same_in_every_suite_that_has_it() {
        let all = suite(Layouts::Random, 5).episodes();
        let mut few = suite(Layouts::Random, 5);
        few.tasks = vec![TaskId::default_of(TASKS[2])];
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
    }

    /// Computed independently: the first eight bytes, little endian, of
    /// `sha256("place/widowx_spoon_on_towel/default/0/0")` and of the same with `sample`.
    const SEEDS_OF_THE_FIRST_EPISODE: (u64, u64) = (3_977_631_995, 8_353_930_603_780_422);

    #[test]
    fn the_grid_has_every_layout_once_before_any_comes_again() {
        let plans = suite(Layouts::Grid, 0).episodes();
        let of_task = plans.iter().filter(|plan| plan.task.task == TASKS[1]);
        let layouts: Vec<Option<u32>> = of_task.map(|plan| plan.layout).collect();
        assert_eq!(layouts[..24], (0..24).map(Some).collect::<Vec<_>>());
        assert_eq!(layouts[24..], (0..6).map(Some).collect::<Vec<_>>());
    }
}
