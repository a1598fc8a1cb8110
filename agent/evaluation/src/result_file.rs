//! The file that `--json` writes: the figures of the tables for other programs, with their provenance.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use decision::Setting;
use serde::Serialize;
use serde_json::Value;

use crate::comparisons::{SettingGain, SettingHeadroom};
use crate::results::{Counts, Results, StepTime, TaskResult};

/// Name of the task, and of the variant, in the rows of the average. Every task has the same weight in it.
pub const AVERAGE: &str = "average";

/// The whole file. Rates, gains, shares and interval ends are fractions of 1; all intervals are 95 % intervals.
#[derive(Debug, Serialize)]
pub struct ResultFile {
    /// One row per setting and task (with variant), and one per setting for the average.
    pub rows: Vec<Row>,
    /// One entry per comparison.
    pub paired: Vec<Paired>,
    /// One entry per setting that chooses among candidates, if the run has a single sample and the oracle.
    pub headroom: Vec<Headroom>,
    /// Time per decision: its share of its batch's time. `None` without decisions.
    pub decision_ms: Option<StepTime>,
    /// Median batch size of decisions.
    pub batch_size: Option<f64>,
    /// Time from an action to the next observation.
    pub step_ms: Option<StepTime>,
    /// The simulator's part of it.
    pub simulator_ms: Option<StepTime>,
    /// Provenance, with the caller's field names: the run's name, options and versions, the command line, the build's
    /// commit, the date.
    #[serde(flatten)]
    pub made_from: Value,
}

/// One setting on one task.
#[derive(Debug, Serialize)]
pub struct Row {
    /// The task's name, or [`AVERAGE`].
    pub task: String,
    /// The task's variant, or [`AVERAGE`].
    pub variant: String,
    /// The strategy that chose the candidates.
    pub strategy: String,
    /// Candidates per step.
    pub candidates: u32,
    /// Sampling temperature; 0 is greedy.
    pub temperature: f32,
    /// Episodes with an outcome: the denominator of all rates of the row.
    pub episodes: u64,
    /// Distinct initial layouts among them; episodes that share one are a cluster.
    pub starts: u64,
    /// Counts that the rates do not include.
    #[serde(flatten)]
    pub counts: Counts,
    /// Rate of episodes in which the object was grasped at some step.
    pub grasp: Option<f64>,
    /// Lower end of the interval of `grasp`.
    pub grasp_low: f64,
    /// Upper end.
    pub grasp_high: f64,
    /// Success at the last step. The average is `None` while a task has no episode.
    pub success: Option<f64>,
    /// Lower end of the interval of `success`.
    pub success_low: f64,
    /// Upper end.
    pub success_high: f64,
    /// Success at some step.
    pub success_any_step: Option<f64>,
    /// Success at the last step with the object let go.
    pub success_released: Option<f64>,
}

/// The difference in success at the last step, `a` minus `b`, averaged over tasks.
#[derive(Debug, Serialize)]
pub struct Paired {
    /// The strategy under test.
    pub a: String,
    /// The strategy that it is compared with.
    pub b: String,
    /// Candidates of `a`.
    pub candidates: u32,
    /// Temperature of `a`; `b` has the same unless it is greedy.
    pub temperature: f32,
    /// Pairs over all tasks.
    pub episodes: u64,
    /// Distinct initial layouts among them.
    pub starts: u64,
    /// Success rate of `a` over the pairs.
    pub success_a: f64,
    /// Success rate of `b` over the pairs.
    pub success_b: f64,
    /// The difference.
    pub gain: f64,
    /// Lower end of its interval.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// The share of the gap between a single sample and the oracle that a setting closes.
#[derive(Debug, Serialize)]
pub struct Headroom {
    /// The strategy under test.
    pub strategy: String,
    /// Candidates per step, the same as for the oracle.
    pub candidates: u32,
    /// Sampling temperature of the strategy, the single sample and the oracle.
    pub temperature: f32,
    /// Episodes that all three have in common.
    pub episodes: u64,
    /// 1 is as good as the oracle.
    pub fraction: f64,
    /// Lower end of its interval; `None` if the oracle may be no better than a single sample.
    pub low: Option<f64>,
    /// Upper end.
    pub high: Option<f64>,
}

impl ResultFile {
    /// The file's contents. `made_from` is an object such as a run's header with the command line, the build's commit
    /// and the date added.
    pub fn new(results: &Results, made_from: Value) -> Result<ResultFile> {
        ensure!(made_from.is_object(), "result file: expected an object, got {made_from}");
        let mut rows = Vec::new();
        for result in &results.settings {
            for (task, of_task) in results.tasks.iter().zip(&result.tasks) {
                rows.push(row(&task.task, &task.variant, &result.setting, of_task));
            }
            rows.push(row(AVERAGE, AVERAGE, &result.setting, &result.all));
        }
        Ok(ResultFile {
            rows,
            paired: results.gains.iter().map(Paired::from).collect(),
            headroom: results.headroom.iter().map(Headroom::from).collect(),
            decision_ms: results.decision_ms,
            batch_size: results.batch_size,
            step_ms: results.step_ms,
            simulator_ms: results.simulator_ms,
            made_from,
        })
    }

    /// Writes the file.
    pub fn write(&self, path: &Path) -> Result<()> {
        let mut text = serde_json::to_string_pretty(self)?;
        text.push('\n');
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
    }
}

impl From<&SettingGain> for Paired {
    fn from(one: &SettingGain) -> Paired {
        Paired {
            a: one.better.strategy.to_string(),
            b: one.worse.strategy.to_string(),
            candidates: one.better.candidates,
            temperature: one.better.temperature,
            episodes: one.gain.pairs,
            starts: one.gain.starts,
            success_a: one.gain.better_rate,
            success_b: one.gain.worse_rate,
            gain: one.gain.mean,
            low: one.gain.interval.low,
            high: one.gain.interval.high,
        }
    }
}

impl From<&SettingHeadroom> for Headroom {
    fn from(one: &SettingHeadroom) -> Headroom {
        Headroom {
            strategy: one.setting.strategy.to_string(),
            candidates: one.setting.candidates,
            temperature: one.setting.temperature,
            episodes: one.headroom.episodes,
            fraction: one.headroom.fraction,
            low: one.headroom.interval.map(|interval| interval.low),
            high: one.headroom.interval.map(|interval| interval.high),
        }
    }
}

fn row(task: &str, variant: &str, setting: &Setting, result: &TaskResult) -> Row {
    let (grasped, success) = (result.grasped, result.success);
    Row {
        task: task.to_owned(),
        variant: variant.to_owned(),
        strategy: setting.strategy.to_string(),
        candidates: setting.candidates,
        temperature: setting.temperature,
        episodes: success.episodes,
        starts: success.starts,
        counts: result.counts,
        grasp: grasped.value,
        grasp_low: grasped.interval.low,
        grasp_high: grasped.interval.high,
        success: success.value,
        success_low: success.interval.low,
        success_high: success.interval.high,
        success_any_step: result.ever_success.value,
        success_released: result.released_success.value,
    }
}
