//! Selects the episodes that count, and groups them into clusters.
//!
//! Episodes of one task with the same initial layout share a start. At temperature 0 nothing is sampled: all episodes
//! of a start are identical, and only the first counts. At other temperatures the episodes of a start are a cluster. An
//! episode in which the policy never acted has no outcome.

use std::collections::{BTreeMap, BTreeSet};

use decision::Setting;
use protocol::Statistics;
use store::run::EpisodeSummary;

use crate::estimate::{Cluster, TaskClusters};

/// The initial layout of an episode, within its task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Start {
    /// One of the fixed initial layouts.
    Layout(u32),
    /// The layout that the environment draws from this seed.
    Seed(u64),
}

/// The episodes of one setting on one task.
#[derive(Default)]
pub struct TaskEpisodes<'a> {
    /// Keyed by the policy's seed, which is 0 if nothing is sampled.
    starts: BTreeMap<Start, BTreeMap<u64, &'a EpisodeSummary>>,
    /// Episodes that repeat a counted one.
    repeats: Vec<&'a EpisodeSummary>,
    /// Episodes in which the policy never acted.
    never_acted: Vec<&'a EpisodeSummary>,
}

/// The episodes of one setting, task by task.
pub struct SettingEpisodes<'a> {
    /// The setting.
    pub setting: Setting,
    /// In the order of the run's tasks.
    pub tasks: Vec<TaskEpisodes<'a>>,
}

impl<'a> TaskEpisodes<'a> {
    fn insert(&mut self, summary: &'a EpisodeSummary, is_drawn: bool) {
        if never_acted(summary) {
            self.never_acted.push(summary);
            return;
        }
        let identity = &summary.identity;
        let start = identity.layout.map_or(Start::Seed(identity.seed), Start::Layout);
        let draw = if is_drawn { identity.sampling_seed } else { 0 };
        let draws = self.starts.entry(start).or_default();
        let first = draws.entry(draw).or_insert(summary);
        if identity.episode < first.identity.episode {
            self.repeats.push(std::mem::replace(first, summary));
        } else if identity.episode > first.identity.episode {
            self.repeats.push(summary);
        }
    }

    /// The episodes that rates are computed over.
    pub fn counted(&self) -> impl Iterator<Item = &'a EpisodeSummary> {
        self.starts.values().flat_map(BTreeMap::values).copied()
    }

    /// Number of episodes that repeat a counted one.
    pub fn repeats(&self) -> u64 {
        self.repeats.len() as u64
    }

    /// Episodes in which the policy never acted.
    pub fn never_acted(&self) -> &[&'a EpisodeSummary] {
        &self.never_acted
    }

    /// The outcomes of the episodes, one cluster per start.
    pub fn clusters(&self, read: impl Fn(&Statistics) -> bool) -> TaskClusters {
        let cluster = |draws: &BTreeMap<u64, &EpisodeSummary>| {
            cluster(draws.values().map(|summary| read(&summary.statistics)))
        };
        self.starts.values().map(cluster).collect()
    }
}

impl<'a> SettingEpisodes<'a> {
    /// A setting without episodes.
    pub fn new(setting: Setting, tasks: usize) -> SettingEpisodes<'a> {
        SettingEpisodes { setting, tasks: (0..tasks).map(|_| TaskEpisodes::default()).collect() }
    }

    /// Adds an episode of the task with this index.
    pub fn insert(&mut self, task: usize, summary: &'a EpisodeSummary) {
        let is_drawn = self.is_drawn();
        self.tasks[task].insert(summary, is_drawn);
    }

    /// Whether candidates are sampled, so that episodes of one start differ.
    fn is_drawn(&self) -> bool {
        self.setting.temperature > 0.0
    }
}

/// The success of several settings on the starts and random numbers that all of them have. The result holds, for each
/// setting and task, the same starts in the same order. A setting that samples nothing has one episode per start; it is
/// paired with all episodes of the other settings.
pub fn in_common<const N: usize>(settings: [&SettingEpisodes<'_>; N]) -> [Vec<TaskClusters>; N] {
    let mut all = [const { Vec::new() }; N];
    let tasks = settings.iter().map(|setting| setting.tasks.len()).min().unwrap_or(0);
    for task in 0..tasks {
        let mut clusters = [const { TaskClusters::new() }; N];
        for start in settings[0].tasks[task].starts.keys() {
            for (list, cluster) in clusters.iter_mut().zip(at_start(&settings, task, start)) {
                list.push(cluster);
            }
        }
        for (list, of_task) in all.iter_mut().zip(clusters) {
            list.push(of_task);
        }
    }
    all
}

/// One cluster per setting; empty if the settings have no episode in common.
fn at_start(settings: &[&SettingEpisodes<'_>], task: usize, start: &Start) -> Vec<Cluster> {
    let mut common: Option<BTreeSet<u64>> = None;
    for setting in settings {
        let Some(draws) = setting.tasks[task].starts.get(start) else { return Vec::new() };
        if setting.is_drawn() {
            let draws = draws.keys().copied();
            common = Some(match common {
                None => draws.collect(),
                Some(known) => draws.filter(|draw| known.contains(draw)).collect(),
            });
        }
    }
    if common.as_ref().is_some_and(BTreeSet::is_empty) {
        return Vec::new();
    }
    let of_setting = |setting: &&SettingEpisodes<'_>| {
        let draws = setting.tasks[task].starts.get(start).into_iter().flatten();
        let is_common = |draw: &u64| {
            !setting.is_drawn() || common.as_ref().is_none_or(|common| common.contains(draw))
        };
        cluster(
            draws
                .filter(|(draw, _)| is_common(draw))
                .map(|(_, summary)| summary.statistics.is_success),
        )
    };
    settings.iter().map(of_setting).collect()
}

fn cluster(outcomes: impl Iterator<Item = bool>) -> Cluster {
    let (mut successes, mut episodes) = (0.0, 0.0);
    for is_success in outcomes {
        successes += f64::from(u8::from(is_success));
        episodes += 1.0;
    }
    Cluster { mean: successes / episodes, episodes }
}

/// Whether no decision of an episode had a well-formed candidate, so that the policy did not control the robot.
pub fn never_acted(summary: &EpisodeSummary) -> bool {
    summary.held_steps as usize >= summary.decision_ms.len()
}
