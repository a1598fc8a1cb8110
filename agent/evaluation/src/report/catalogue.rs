//! The catalogue: one short entry per episode, paired by initial layout. The page's list, filters and sorting need no more.

use std::collections::{BTreeMap, BTreeSet};

use decision::{Setting, TaskId, VARIANT_DEFAULT};
use serde::Serialize;

use store::record::EpisodeIdentity;
use store::run::{EpisodeSummary, FaultRecord};
use store::video::FRAMES_PER_SECOND;

use super::milestones::Milestones;
use super::strategies;
use crate::comparisons::SettingGain;
use crate::counted::never_acted;
use crate::results::Results;

/// What `data/catalogue.js` holds.
#[derive(Serialize)]
pub struct Catalogue {
    pub run: String,
    pub frames_per_second: u32,
    pub tasks: Vec<String>,
    pub settings: Vec<SettingEntry>,
    /// The two settings that are shown side by side at first; the second is missing in a run of one setting.
    pub compared: (usize, Option<usize>),
    /// The pair that the page opens on.
    pub opening: usize,
    /// What each term of a score is; empty where no score's terms are known.
    pub terms: Vec<String>,
    pub pairs: Vec<Pair>,
}

/// A setting as the page names it.
#[derive(Serialize)]
pub struct SettingEntry {
    pub name: String,
    pub strategy: String,
    /// How it chooses among the candidates, as a sentence.
    pub choice: &'static str,
}

/// The episodes of one initial layout.
#[derive(Serialize)]
pub struct Pair {
    /// An index of the tasks.
    pub task: usize,
    pub layout: String,
    pub episodes: Vec<Entry>,
}

/// One episode.
#[derive(Serialize)]
pub struct Entry {
    /// An index of the settings.
    pub setting: usize,
    pub id: String,
    pub outcome: &'static str,
    pub steps: u32,
    /// Attempts that broke.
    #[serde(skip_serializing_if = "is_zero")]
    pub faults: u32,
    /// Why the last attempt broke, where no attempt ended.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    #[serde(skip_serializing_if = "is_false")]
    pub video: bool,
    /// Whether the steps are in the report.
    #[serde(skip_serializing_if = "is_false")]
    pub detail: bool,
    #[serde(flatten)]
    pub milestones: Milestones,
}

fn is_zero(count: &u32) -> bool {
    *count == 0
}

fn is_false(flag: &bool) -> bool {
    !*flag
}

/// A fixed layout by its number, a random one by the number of its episode.
fn layout_name(identity: &EpisodeIdentity) -> String {
    match identity.layout {
        Some(layout) => format!("layout {layout}"),
        None => format!("random {}", identity.episode),
    }
}

impl Catalogue {
    /// Lists all episodes, task by task in the order of the results. At most `details_max` of them come with their steps.
    pub fn new(
        run: &str,
        summaries: &[EpisodeSummary],
        faults: &[FaultRecord],
        results: &Results,
        has_video: impl Fn(&str) -> bool,
        details_max: usize,
    ) -> anyhow::Result<Self> {
        let settings: Vec<Setting> = results.settings.iter().map(|one| one.setting).collect();
        let mut pairs: BTreeMap<(usize, u32), Pair> = BTreeMap::new();
        let mut add = |identity: &EpisodeIdentity, entry: Entry| {
            let id = identity.task_id();
            let task = results.tasks.iter().position(|task| *task == id).unwrap_or_default();
            let pair = pairs.entry((task, identity.episode)).or_insert_with(|| Pair {
                task,
                layout: layout_name(identity),
                episodes: Vec::new(),
            });
            pair.episodes.push(entry);
        };
        let broken = broken(faults);
        let mut recorded = BTreeSet::new();
        for summary in summaries {
            let id = summary.identity.id();
            let entry = Entry {
                setting: place(&settings, &summary.identity)?,
                outcome: outcome(summary),
                steps: summary.steps,
                faults: broken.get(&id).map_or(0, |list| list.len() as u32),
                reason: None,
                video: has_video(&id),
                detail: false,
                milestones: Milestones::default(),
                id,
            };
            recorded.insert(entry.id.clone());
            add(&summary.identity, entry);
        }
        for (id, list) in broken.into_iter().filter(|(id, _)| !recorded.contains(id)) {
            let Some(last) = list.last() else { continue };
            let entry = Entry {
                setting: place(&settings, &last.identity)?,
                outcome: "fault",
                steps: 0,
                faults: list.len() as u32,
                reason: Some(last.reason.clone()),
                video: false,
                detail: false,
                milestones: Milestones::default(),
                id,
            };
            add(&last.identity, entry);
        }
        let mut pairs: Vec<Pair> = pairs.into_values().collect();
        pairs.iter_mut().for_each(|pair| pair.episodes.sort_by_key(|entry| entry.setting));
        let compared = compared(&settings, results.main_gain());
        let opening = opening(&pairs, compared);
        grant_details(&mut pairs, opening, details_max);
        Ok(Self {
            run: run.to_owned(),
            frames_per_second: FRAMES_PER_SECOND,
            tasks: results.tasks.iter().map(task_words).collect(),
            settings: settings.iter().map(setting_entry).collect(),
            compared,
            opening,
            terms: Vec::new(),
            pairs,
        })
    }

    /// All episodes, those that only broke included.
    #[cfg(test)]
    pub fn episodes(&self) -> impl Iterator<Item = &Entry> {
        self.pairs.iter().flat_map(|pair| &pair.episodes)
    }

    /// The episodes that have a record.
    pub fn recorded_mut(&mut self) -> impl Iterator<Item = &mut Entry> {
        let all = self.pairs.iter_mut().flat_map(|pair| &mut pair.episodes);
        all.filter(|entry| entry.reason.is_none())
    }
}

/// The attempts that broke, by episode.
fn broken(faults: &[FaultRecord]) -> BTreeMap<String, Vec<&FaultRecord>> {
    let mut broken: BTreeMap<String, Vec<&FaultRecord>> = BTreeMap::new();
    for fault in faults {
        broken.entry(fault.identity.id()).or_default().push(fault);
    }
    broken
}

fn place(settings: &[Setting], identity: &EpisodeIdentity) -> anyhow::Result<usize> {
    let setting = identity.setting()?;
    Ok(settings.iter().position(|one| *one == setting).unwrap_or_default())
}

fn setting_entry(setting: &Setting) -> SettingEntry {
    SettingEntry {
        name: setting.to_string(),
        strategy: setting.strategy.to_string(),
        choice: strategies::choice(*setting),
    }
}

/// The headline's comparison; without one, the first two settings.
fn compared(settings: &[Setting], main: Option<&SettingGain>) -> (usize, Option<usize>) {
    let place = |setting: Setting| settings.iter().position(|one| *one == setting);
    match main.map(|gain| (place(gain.better), place(gain.worse))) {
        Some((Some(better), Some(worse))) => (better, Some(worse)),
        _ => (0, (settings.len() > 1).then_some(1)),
    }
}

/// A pair that the first setting won, with videos and near the start if possible; else one with much to look at.
fn opening(pairs: &[Pair], (first, second): (usize, Option<usize>)) -> usize {
    let rank = |(index, pair): &(usize, &Pair)| {
        let of = |setting| pair.episodes.iter().find(|entry| entry.setting == setting);
        let (ours, theirs) = (of(first), second.and_then(of));
        let succeeds = |entry: Option<&Entry>| entry.is_some_and(|one| one.outcome == "success");
        let is_won = succeeds(ours) && !succeeds(theirs) && theirs.is_some();
        // One that succeeded and lost it again shows less of a difference.
        let is_clear = is_won && theirs.is_some_and(|one| one.outcome != "lost");
        let videos = [ours, theirs].into_iter().flatten().filter(|entry| entry.video).count();
        let is_whole = ours.is_some() && (theirs.is_some() || second.is_none());
        (is_won, videos, is_clear, is_whole, succeeds(ours), std::cmp::Reverse(*index))
    };
    pairs.iter().enumerate().max_by_key(rank).map_or(0, |(index, _)| index)
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

/// The opening pair first, then episodes with a video, then low numbers of every task, so that whole pairs stay together.
fn grant_details(pairs: &mut [Pair], opening: usize, details_max: usize) {
    let mut order = Vec::new();
    let mut places: BTreeMap<usize, usize> = BTreeMap::new();
    for (index, pair) in pairs.iter().enumerate() {
        let place = places.entry(pair.task).or_default();
        for (entry, episode) in pair.episodes.iter().enumerate() {
            if episode.reason.is_none() {
                order.push((index != opening, !episode.video, *place, index, entry));
            }
        }
        *place += 1;
    }
    order.sort_unstable();
    for (_, _, _, pair, entry) in order.into_iter().take(details_max) {
        pairs[pair].episodes[entry].detail = true;
    }
}

/// The outcome at the last step of an episode, or else the furthest that it had reached before; `none` where the policy
/// never acted.
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

    fn made_up(with_video: &str, details_max: usize) -> Catalogue {
        let summaries = sample::summaries();
        let order = [sample::TASKS[1], sample::TASKS[0]].map(TaskId::default_of);
        let faults = sample::faults();
        let results = Results::new(&summaries, &faults, &order).expect("results");
        let has_video = |id: &str| id == with_video;
        Catalogue::new("run", &summaries, &faults, &results, has_video, details_max)
            .expect("a catalogue")
    }

    #[test]
    fn settings_of_one_layout_share_a_pair_in_the_order_of_the_run() {
        let catalogue = made_up("", 1000);
        assert_eq!(catalogue.tasks, ["stack cube", "spoon on towel"]);
        assert_eq!(catalogue.pairs[0].task, 0);
        let recorded = sample::summaries().len();
        assert_eq!(catalogue.episodes().count(), recorded + 1, "and one that only broke");
        for pair in &catalogue.pairs {
            let settings: BTreeSet<usize> = pair.episodes.iter().map(|one| one.setting).collect();
            assert_eq!(settings.len(), pair.episodes.len());
        }
        let (ours, theirs) = catalogue.compared;
        assert_eq!(catalogue.settings[ours].name, "verifier N=5 T=1");
        assert_eq!(catalogue.settings[theirs.expect("two")].name, "sample T=1");
    }

    #[test]
    fn the_page_opens_on_a_pair_that_the_verifier_won() {
        let catalogue = made_up("", 2);
        let (ours, theirs) = catalogue.compared;
        let pair = &catalogue.pairs[catalogue.opening];
        let outcome = |setting| {
            pair.episodes.iter().find(|one| one.setting == setting).map(|one| one.outcome)
        };
        assert_eq!(outcome(ours), Some("success"));
        assert_ne!(theirs.and_then(outcome), Some("success"));
        assert!(pair.episodes.iter().take(2).all(|one| one.detail), "its steps come first");
    }

    #[test]
    fn steps_go_to_the_opening_pair_then_to_videos() {
        let summaries = sample::summaries();
        let video = summaries.last().expect("episodes").identity.id();
        let catalogue = made_up(&video, 4);
        let detailed: Vec<&Entry> = catalogue.episodes().filter(|entry| entry.detail).collect();
        assert_eq!(detailed.len(), 4);
        assert!(detailed.iter().any(|entry| entry.id == video));
    }

    #[test]
    fn an_episode_that_only_broke_is_listed_with_its_reason() {
        let catalogue = made_up("", 1000);
        let broken = catalogue.episodes().find(|entry| entry.outcome == "fault").expect("a fault");
        assert_eq!((broken.faults, broken.detail), (2, false));
        assert_eq!(broken.reason.as_deref(), Some("the server went away"));
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
