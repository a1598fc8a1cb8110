//! The results of a run: rates of every setting on every task, paired gains, headroom, times.

use std::collections::BTreeSet;

use anyhow::Result;
use decision::{Setting, TaskId};
use protocol::Statistics;
use serde_json::Value;
use store::run::{EpisodeSummary, FaultRecord};

use crate::comparisons::{self, SettingGain, SettingHeadroom};
use crate::counted::{SettingEpisodes, TaskEpisodes};
use crate::estimate::{Rate, TaskClusters};
use crate::statistics::quantile;

/// Everything that tables and report show.
#[derive(Debug, Clone)]
pub struct Results {
    /// Tasks in the order of every table.
    pub tasks: Vec<TaskId>,
    /// One entry per setting, highest temperature first.
    pub settings: Vec<SettingResult>,
    /// Paired comparisons between settings.
    pub gains: Vec<SettingGain>,
    /// The share of the gap between a single sample and the oracle that each setting closes.
    pub headroom: Vec<SettingHeadroom>,
    /// Time per decision: its share of its batch's time.
    pub decision_ms: Option<StepTime>,
    /// Median batch size of decisions.
    pub batch_size: Option<f64>,
    /// Time from an action to the next observation, including the wait for the server's other sessions.
    pub step_ms: Option<StepTime>,
    /// The simulator's part of it.
    pub simulator_ms: Option<StepTime>,
    /// Names of the episodes that rates are computed over.
    pub counted: BTreeSet<String>,
}

/// One setting on every task.
#[derive(Debug, Clone)]
pub struct SettingResult {
    /// The setting.
    pub setting: Setting,
    /// In the order of the tasks; without episodes for a task on which the setting did not run.
    pub tasks: Vec<TaskResult>,
    /// The average over tasks with equal weight, and the sums of their counts.
    pub all: TaskResult,
}

/// Rates and counts of one setting, on one task or over all tasks.
#[derive(Debug, Clone, Copy)]
pub struct TaskResult {
    /// The object was grasped at some step.
    pub grasped: Rate,
    /// Success at the last step, as in SIMPLER.
    pub success: Rate,
    /// Success at some step.
    pub ever_success: Rate,
    /// Success at the last step with the object let go.
    pub released_success: Rate,
    /// Counts that the rates do not include.
    pub counts: Counts,
}

/// Counts that the rates do not include.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counts {
    /// Attempts without an outcome, retried or given up. They count in no rate.
    pub faults: u64,
    /// Distinct episodes in which the policy never acted: no candidate was well formed. They count in no rate.
    pub never_acted: u64,
    /// Episodes that repeat a counted one because nothing in them is sampled.
    pub repeats: u64,
    /// Candidates of counted episodes and of those in which the policy never acted.
    pub proposed: u64,
    /// Candidates without a valid action, which are never executed.
    pub malformed: u64,
    /// Decisions of the same episodes.
    pub decisions: u64,
    /// Decisions without a well-formed candidate: the robot held still.
    pub held_steps: u64,
}

/// Milliseconds over all steps of all episodes.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct StepTime {
    /// Median.
    pub p50: f64,
    /// 95th percentile.
    pub p95: f64,
}

impl Results {
    /// The results of a run's episodes and failed attempts. `order` holds the run's tasks, see [`tasks_in_order`].
    pub fn new(
        summaries: &[EpisodeSummary],
        faults: &[FaultRecord],
        order: &[TaskId],
    ) -> Result<Results> {
        let identities = || {
            let recorded = summaries.iter().map(|summary| &summary.identity);
            recorded.chain(faults.iter().map(|fault| &fault.identity))
        };
        let tasks = in_order(identities().map(|identity| identity.task_id()), order);
        let mut settings: Vec<Setting> = Vec::new();
        for identity in identities() {
            let setting = identity.setting()?;
            // A setting of which every attempt failed still has a row.
            if !settings.contains(&setting) {
                settings.push(setting);
            }
        }
        settings.sort_by(|a, b| {
            let by_temperature = b.temperature.total_cmp(&a.temperature);
            by_temperature.then(a.strategy.cmp(&b.strategy)).then(a.candidates.cmp(&b.candidates))
        });
        let mut episodes: Vec<SettingEpisodes<'_>> =
            settings.iter().map(|setting| SettingEpisodes::new(*setting, tasks.len())).collect();
        for summary in summaries {
            let (setting, id) = (summary.identity.setting()?, summary.identity.task_id());
            let mine = episodes.iter_mut().find(|one| one.setting == setting);
            let task = tasks.iter().position(|task| *task == id);
            if let Some((mine, task)) = mine.zip(task) {
                mine.insert(task, summary);
            }
        }
        let all_counted =
            || episodes.iter().flat_map(|one| &one.tasks).flat_map(TaskEpisodes::counted);
        Ok(Results {
            gains: comparisons::gains(&episodes),
            headroom: comparisons::headroom(&episodes),
            decision_ms: step_time(summaries, |summary| &summary.decision_ms),
            batch_size: median(summaries.iter().flat_map(|one| &one.batch_size)),
            step_ms: step_time(summaries, |summary| &summary.step_ms),
            simulator_ms: step_time(summaries, |summary| &summary.simulator_ms),
            counted: all_counted().map(|summary| summary.identity.id()).collect(),
            settings: episodes
                .iter()
                .map(|one| setting_result(one, &tasks, faults))
                .collect::<Result<_>>()?,
            tasks,
        })
    }

    /// The comparison of the headline.
    pub fn main_gain(&self) -> Option<&SettingGain> {
        comparisons::main_gain(&self.gains)
    }
}

/// The tasks in a run's options, in the order of its tables.
pub fn tasks_in_order(options: &Value) -> Vec<TaskId> {
    let names = options["tasks"].as_array().map_or(&[][..], Vec::as_slice);
    names.iter().filter_map(|name| name.as_str()?.parse().ok()).collect()
}

/// The tasks without duplicates: those of `order` first, then any others by name.
fn in_order(tasks: impl Iterator<Item = TaskId>, order: &[TaskId]) -> Vec<TaskId> {
    let mut tasks: BTreeSet<TaskId> = tasks.collect();
    let mut ordered: Vec<TaskId> = order.iter().filter_map(|task| tasks.take(task)).collect();
    ordered.extend(tasks);
    ordered
}

fn setting_result(
    episodes: &SettingEpisodes<'_>,
    tasks: &[TaskId],
    faults: &[FaultRecord],
) -> Result<SettingResult> {
    let mut counts = Vec::with_capacity(tasks.len());
    for (task, of_task) in tasks.iter().zip(&episodes.tasks) {
        let mut mine = Vec::new();
        for fault in faults {
            let identity = &fault.identity;
            if identity.task_id() == *task && identity.setting()? == episodes.setting {
                mine.push(fault);
            }
        }
        counts.push(count(of_task, &mine));
    }
    let result = |of: &[TaskEpisodes<'_>], counts: &[Counts]| {
        let rate = |read: fn(&Statistics) -> bool| {
            let clusters: Vec<TaskClusters> = of.iter().map(|task| task.clusters(read)).collect();
            Rate::over_tasks(&clusters)
        };
        TaskResult {
            grasped: rate(|statistics| statistics.ever_grasped),
            success: rate(|statistics| statistics.is_success),
            ever_success: rate(|statistics| statistics.ever_success),
            released_success: rate(|statistics| statistics.released_success),
            counts: counts.iter().copied().fold(Counts::default(), Counts::plus),
        }
    };
    let each = episodes.tasks.chunks(1).zip(counts.chunks(1));
    Ok(SettingResult {
        setting: episodes.setting,
        tasks: each.map(|(task, counts)| result(task, counts)).collect(),
        all: result(&episodes.tasks, &counts),
    })
}

fn count(episodes: &TaskEpisodes<'_>, faults: &[&FaultRecord]) -> Counts {
    let mut counts = Counts {
        faults: faults.len() as u64,
        never_acted: episodes.never_acted().len() as u64,
        repeats: episodes.repeats(),
        ..Counts::default()
    };
    for summary in episodes.counted().chain(episodes.never_acted().iter().copied()) {
        counts.proposed += u64::from(summary.candidates);
        counts.malformed += u64::from(summary.malformed);
        counts.decisions += summary.decision_ms.len() as u64;
        counts.held_steps += u64::from(summary.held_steps);
    }
    counts
}

impl Counts {
    /// The sums.
    pub fn plus(self, other: Counts) -> Counts {
        Counts {
            faults: self.faults + other.faults,
            never_acted: self.never_acted + other.never_acted,
            repeats: self.repeats + other.repeats,
            proposed: self.proposed + other.proposed,
            malformed: self.malformed + other.malformed,
            decisions: self.decisions + other.decisions,
            held_steps: self.held_steps + other.held_steps,
        }
    }
}

fn step_time(
    summaries: &[EpisodeSummary],
    of: fn(&EpisodeSummary) -> &Vec<f32>,
) -> Option<StepTime> {
    let sorted = sorted(summaries.iter().flat_map(of).map(|value| f64::from(*value)));
    let time = StepTime { p50: quantile(&sorted, 0.50), p95: quantile(&sorted, 0.95) };
    (!sorted.is_empty()).then_some(time)
}

fn median<'a>(values: impl Iterator<Item = &'a u32>) -> Option<f64> {
    let sorted = sorted(values.map(|value| f64::from(*value)));
    (!sorted.is_empty()).then(|| quantile(&sorted, 0.5))
}

fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values
}

#[cfg(test)]
mod tests;
