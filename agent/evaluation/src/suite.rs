//! Suites: the episodes that an evaluation consists of.
//!
//! Seeds are derived from an episode's identity, never from the worker that runs it or the time. So a resumed, a
//! distributed and an uninterrupted run have the same episodes. The policy's seed does not depend on the strategy: all
//! settings of one episode have the same initial layout and the same random numbers, which pairs their outcomes.

use anyhow::Context;
use clap::ValueEnum;
use decision::{episode_hash, episode_name, sampling_seed};
use serde::{Deserialize, Serialize};
use store::plan::{EpisodePlan, OfferedTask, SEEDS_PER_RANGE, SeedRange};

/// The initial layouts of the episodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Layouts {
    /// The task's fixed layouts in order, repeated as often as needed.
    Grid,
    /// Drawn from each episode's seed.
    Random,
}

/// The episodes to run.
#[derive(Debug, Clone, PartialEq)]
pub struct Suite {
    /// Tasks, each in a variant.
    pub tasks: Vec<OfferedTask>,
    /// Episodes per task.
    pub episodes: u32,
    /// Fixed or random initial layouts.
    pub layouts: Layouts,
    /// The range that seeds are drawn from.
    pub range: SeedRange,
    /// Determines the random layouts and the samples.
    pub seed: u64,
}

impl Suite {
    /// The episodes. Tasks alternate, so that a partial run covers all tasks equally. An error if a task has no fixed
    /// layouts and is to be run on them.
    pub fn episodes(&self) -> anyhow::Result<Vec<EpisodePlan>> {
        let numbers = 0..self.episodes;
        numbers
            .flat_map(|episode| self.tasks.iter().map(move |task| self.episode(task, episode)))
            .collect()
    }

    fn episode(&self, task: &OfferedTask, episode: u32) -> anyhow::Result<EpisodePlan> {
        let OfferedTask { id: task, layouts, .. } = task;
        let layout = match self.layouts {
            Layouts::Random => None,
            Layouts::Grid => Some(episode.checked_rem(*layouts).with_context(|| {
                format!(
                    "layouts: expected random ones for {task}, which has no fixed layouts, got grid"
                )
            })?),
        };
        let name = episode_name(task, episode);
        let place = episode_hash("place", &name, self.seed);
        Ok(EpisodePlan {
            task: task.clone(),
            layout,
            episode,
            seed: self.range.first() + place % SEEDS_PER_RANGE,
            sampling_seed: sampling_seed(&name, self.seed),
        })
    }
}

#[cfg(test)]
mod tests {
    use decision::TaskId;

    use super::*;

    const TASKS: [&str; 4] = [
        "widowx_spoon_on_towel",
        "widowx_carrot_on_plate",
        "widowx_stack_cube",
        "widowx_put_eggplant_in_basket",
    ];

    fn suite(layouts: Layouts, seed: u64) -> Suite {
        let tasks = TASKS
            .map(|task| OfferedTask { id: TaskId::default_of(task), layouts: 24, steps_max: 60 })
            .to_vec();
        Suite { tasks, episodes: 30, layouts, range: SeedRange::Evaluation, seed }
    }

    fn plans(suite: &Suite) -> Vec<EpisodePlan> {
        suite.episodes().expect("fixed layouts")
    }

    #[test]
    fn an_episode_is_the_same_in_every_suite_that_has_it() {
        let all = plans(&suite(Layouts::Random, 5));
        let mut few = suite(Layouts::Random, 5);
        few.tasks = vec![few.tasks.remove(2)];
        few.episodes = 7;
        for plan in plans(&few) {
            assert!(all.contains(&plan), "{plan:?}");
        }
    }

    #[test]
    fn seeds_differ_and_stay_in_their_range() {
        let mut all = plans(&suite(Layouts::Random, 0));
        all.extend(plans(&suite(Layouts::Random, 1)));
        assert!(all.iter().all(|plan| SeedRange::Evaluation.contains(plan.seed)));
        assert!(all.iter().all(|plan| !SeedRange::Collection.contains(plan.seed)));
        assert!(all.iter().all(|plan| plan.sampling_seed < 1 << 53));
        for seeds in [|plan: &EpisodePlan| plan.seed, |plan: &EpisodePlan| plan.sampling_seed] {
            let different: std::collections::BTreeSet<u64> = all.iter().map(seeds).collect();
            assert_eq!(different.len(), all.len());
        }
    }

    #[test]
    fn seeds_never_change_between_versions() {
        let plan = &plans(&suite(Layouts::Random, 0))[0];
        assert_eq!((plan.seed, plan.sampling_seed), SEEDS_OF_THE_FIRST_EPISODE);
    }

    /// Computed independently: the first eight bytes, little endian, of
    /// `sha256("place/widowx_spoon_on_towel/default/0/0")` and of the same with `sample` instead of `place`.
    const SEEDS_OF_THE_FIRST_EPISODE: (u64, u64) = (3_977_631_995, 8_353_930_603_780_422);

    #[test]
    fn the_grid_has_every_layout_of_a_task_once_before_any_comes_again() {
        let mut suite = suite(Layouts::Grid, 0);
        suite.tasks[1].layouts = 7;
        let layouts = |task: usize| -> Vec<Option<u32>> {
            let of_task = plans(&suite).into_iter().filter(|plan| plan.task.task == TASKS[task]);
            of_task.map(|plan| plan.layout).collect()
        };
        let expected =
            |count: u32| (0..30).map(|episode| Some(episode % count)).collect::<Vec<_>>();
        assert_eq!((layouts(0), layouts(1)), (expected(24), expected(7)));
    }

    #[test]
    fn a_task_without_fixed_layouts_has_no_grid() {
        let mut suite = suite(Layouts::Grid, 0);
        suite.tasks[2].layouts = 0;
        let error = suite.episodes().expect_err("no grid").to_string();
        let expected = "layouts: expected random ones for widowx_stack_cube, which has no fixed layouts, got grid";
        assert_eq!(error, expected);
        suite.layouts = Layouts::Random;
        assert_eq!(plans(&suite).len(), 120);
    }
}
