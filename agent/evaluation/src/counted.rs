//! Which episodes of a run count, and which of them belong together.
//!
//! Episodes of one task with the same initial layout share a start. Where nothing is drawn (temperature 0) all episodes of a
//! start are one and the same, so that only the first counts; where candidates are drawn they are a cluster. An episode in
//! which the policy never acted is no outcome.

use std::collections::{BTreeMap, BTreeSet};

use decision::Setting;
use protocol::Statistics;
use store::run::EpisodeSummary;

use crate::estimate::{Cluster, TaskClusters};

/// Where an episode begins, within its task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Start {
    /// One of the fixed initial layouts.
    Layout(u32),
    /// Whatever the environment draws from this seed.
    Seed(u64),
}

/// The episodes of one setting on one task.
#[derive(Default)]
pub struct TaskEpisodes<'a> {
    /// By the policy's seed, which is 0 where nothing is drawn.
    starts: BTreeMap<Start, BTreeMap<u64, &'a EpisodeSummary>>,
    /// Those that repeat another one.
    repeats: Vec<&'a EpisodeSummary>,
    /// Those without any action of the policy's.
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

    /// The episodes that are in the rates.
    pub fn counted(&self) -> impl Iterator<Item = &'a EpisodeSummary> {
        self.starts.values().flat_map(BTreeMap::values).copied()
    }

    /// Episodes that repeat one that is counted.
    pub fn repeats(&self) -> u64 {
        self.repeats.len() as u64
    }

    /// Episodes in which the policy never acted.
    pub fn never_acted(&self) -> &[&'a EpisodeSummary] {
        &self.never_acted
    }

    /// What the episodes of each start came to.
    pub fn clusters(&self, read: impl Fn(&Statistics) -> bool) -> TaskClusters {
        let cluster = |draws: &BTreeMap<u64, &EpisodeSummary>| {
            cluster(draws.values().map(|summary| read(&summary.statistics)))
        };
        self.starts.values().map(cluster).collect()
    }
}

impl<'a> SettingEpisodes<'a> {
    /// Of a setting without episodes so far.
    pub fn new(setting: Setting, tasks: usize) -> SettingEpisodes<'a> {
        SettingEpisodes { setting, tasks: (0..tasks).map(|_| TaskEpisodes::default()).collect() }
    }

    /// Adds an episode on the task of that number.
    pub fn insert(&mut self, task: usize, summary: &'a EpisodeSummary) {
        let is_drawn = self.is_drawn();
        self.tasks[task].insert(summary, is_drawn);
    }

    /// Whether episodes of one start differ.
    fn is_drawn(&self) -> bool {
        self.setting.temperature > 0.0
    }
}

/// The success of several settings on the starts and with the random numbers that all of them have: for each setting, task
/// by task, the same starts. Where one setting draws nothing, its one episode of a start is paired with all of another's.
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

/// One cluster per setting; none at all where they have nothing in common.
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

/// Whether no decision of an episode had a well-formed candidate: what the robot did was not the policy's doing.
pub fn never_acted(summary: &EpisodeSummary) -> bool {
    summary.held_steps as usize >= summary.decision_ms.len()
}
