//! The catalogue: one short entry per episode, which is all that the list and its filters need.

use std::collections::{BTreeMap, BTreeSet};

use decision::{TaskId, VARIANT_DEFAULT};
use serde::Serialize;

use store::run::EpisodeSummary;
use store::video::FRAMES_PER_SECOND;

use crate::counted::never_acted;

/// What `data/catalogue.js` holds.
#[derive(Serialize)]
pub struct Catalogue {
    pub frames_per_second: u32,
    pub episodes: Vec<Entry>,
}

/// One line of the list.
#[derive(Serialize)]
pub struct Entry {
    pub id: String,
    /// Entries with the same number are one layout under different settings.
    pub pair: usize,
    pub task: String,
    pub layout: String,
    pub strategy: String,
    pub candidates: u32,
    pub temperature: f32,
    pub outcome: &'static str,
    pub steps: u32,
    pub video: bool,
    /// Whether the steps are in the report.
    pub detail: bool,
}

impl Catalogue {
    /// Lists all episodes, task by task in the given order; at most `details_max` of them come with their steps.
    pub fn new(
        summaries: &[EpisodeSummary],
        tasks: &[TaskId],
        has_video: impl Fn(&str) -> bool,
        details_max: usize,
    ) -> Self {
        let mut pairs = BTreeMap::new();
        let mut episodes: Vec<Entry> = Vec::with_capacity(summaries.len());
        for summary in in_order(summaries, tasks) {
            let identity = &summary.identity;
            let place = (&identity.task, &identity.variant, identity.episode);
            let count = pairs.len();
            let id = identity.id();
            episodes.push(Entry {
                pair: *pairs.entry(place).or_insert(count),
                task: task_words(&identity.task_id()),
                layout: match identity.layout {
                    Some(layout) => format!("grid {layout}"),
                    None => format!("random {}", identity.episode),
                },
                strategy: identity.strategy.clone(),
                candidates: identity.candidates,
                temperature: identity.temperature,
                outcome: outcome(summary),
                steps: summary.steps,
                video: has_video(&id),
                detail: false,
                id,
            });
        }
        grant_details(&mut episodes, details_max);
        Self { frames_per_second: FRAMES_PER_SECOND, episodes }
    }

    /// The names of the episodes whose steps belong into the report.
    pub fn detailed(&self) -> BTreeSet<&str> {
        self.episodes.iter().filter(|entry| entry.detail).map(|entry| entry.id.as_str()).collect()
    }
}

/// A task's name for people: `widowx_spoon_on_towel` is "spoon on towel".
pub fn task_words(id: &TaskId) -> String {
    let name = id.task.strip_prefix("widowx_").unwrap_or(&id.task);
    let name = name.strip_prefix("put_").unwrap_or(name).replace('_', " ");
    match id.variant.as_str() {
        VARIANT_DEFAULT => name,
        variant => format!("{name} ({variant})"),
    }
}

/// Layouts in order of their numbers, the settings of one layout together.
fn in_order<'a>(summaries: &'a [EpisodeSummary], tasks: &[TaskId]) -> Vec<&'a EpisodeSummary> {
    let mut ordered: Vec<&EpisodeSummary> = summaries.iter().collect();
    ordered.sort_by(|a, b| {
        let key = |summary: &EpisodeSummary| {
            let identity = &summary.identity;
            let task = tasks.iter().position(|task| *task == identity.task_id());
            (task, identity.episode, identity.id())
        };
        key(a).cmp(&key(b))
    });
    ordered
}

/// Episodes with a video first, then low numbers, so that whole pairs stay together.
fn grant_details(episodes: &mut [Entry], details_max: usize) {
    let mut order: Vec<usize> = (0..episodes.len()).collect();
    order.sort_by_cached_key(|index| {
        (!episodes[*index].video, place_in_task(episodes, *index), *index)
    });
    for index in order.into_iter().take(details_max) {
        episodes[index].detail = true;
    }
}

/// How many layouts of the same task come before this one.
fn place_in_task(episodes: &[Entry], index: usize) -> usize {
    let first = episodes.iter().position(|entry| entry.task == episodes[index].task);
    episodes[index].pair - first.map_or(0, |first| episodes[first].pair)
}

/// What became of an episode, told by its last step and by what it had reached before; `none` where the policy never acted.
fn outcome(summary: &EpisodeSummary) -> &'static str {
    let statistics = &summary.statistics;
    if never_acted(summary) {
        return "none";
    }
    match (statistics.is_success, statistics.ever_success, statistics.ever_grasped) {
        (true, _, _) => "success",
        (false, true, _) => "lost",
        (false, false, true) => "grasped",
        (false, false, false) => "failure",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::sample;

    #[test]
    fn settings_of_one_layout_share_a_pair_and_videos_come_first() {
        let summaries = sample::summaries();
        let order = [sample::TASKS[1], sample::TASKS[0]].map(TaskId::default_of);
        let with_video = summaries[5].identity.id();
        let catalogue = Catalogue::new(&summaries, &order, |id| id == with_video, 3);
        assert_eq!(catalogue.episodes.len(), summaries.len());
        assert_eq!(catalogue.detailed().len(), 3);
        assert_eq!(catalogue.episodes[0].task, "stack cube", "the order of the run");
        assert!(catalogue.detailed().contains(with_video.as_str()));
        for one in &catalogue.episodes {
            for other in &catalogue.episodes {
                let same = (&one.task, &one.layout) == (&other.task, &other.layout);
                assert_eq!(same, one.pair == other.pair, "{} and {}", one.id, other.id);
            }
        }
    }

    #[test]
    fn an_episode_in_which_the_policy_never_acted_has_no_outcome() {
        let mut summary = sample::summaries().remove(0);
        assert_ne!(outcome(&summary), "none");
        summary.held_steps = summary.decision_ms.len() as u32;
        assert_eq!(outcome(&summary), "none");
    }

    #[test]
    fn tasks_are_named_for_people() {
        assert_eq!(
            task_words(&TaskId::default_of("widowx_put_eggplant_in_basket")),
            "eggplant in basket"
        );
        let variant = TaskId::new("widowx_stack_cube", "distractors");
        assert_eq!(task_words(&variant), "stack cube (distractors)");
    }
}
