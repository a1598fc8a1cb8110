//! The file that `--json` writes: the same figures as the tables, for programs.

use std::path::Path;

use anyhow::{Context, Result};
use serde::Serialize;
use serde_json::Value;

use crate::results::{Rates, Results, StepTime};
use crate::statistics::Rate;
use decision::{Setting, VARIANT_DEFAULT};

/// The task that stands for all tasks together.
pub const AVERAGE: &str = "average";

/// The whole file. Rates, gains and interval ends are fractions of 1.
#[derive(Debug, Serialize)]
pub struct ResultFile {
    /// One row per setting and task, and one per setting for all tasks.
    pub rows: Vec<Row>,
    /// One entry per comparison.
    pub paired: Vec<Paired>,
    /// One entry per setting that chooses, where one sample and the oracle ran beside it.
    pub headroom: Vec<Headroom>,
    /// Of a whole batch; none when nothing was decided.
    pub decision_ms: Option<StepTime>,
    /// From an action to the next observation.
    pub step_ms: Option<StepTime>,
    /// Of that, the simulator's own; none when no simulator said so.
    pub simulator_ms: Option<StepTime>,
    /// Of everything that the results depend on, by name.
    pub versions: Value,
}

/// One setting on one task.
#[derive(Debug, Serialize)]
pub struct Row {
    /// The task's name, or [`AVERAGE`].
    pub task: String,
    /// The task's variant.
    pub variant: String,
    /// How candidates were chosen.
    pub strategy: String,
    /// Candidates per step.
    pub candidates: u32,
    /// Sampling temperature; 0 is greedy.
    pub temperature: f32,
    /// Episodes with an outcome: the number that all rates of the row are over.
    pub episodes: u64,
    /// Attempts that broke and were run again or given up; in no rate.
    pub faults: u64,
    /// The object was held at some step.
    pub grasp: Option<f64>,
    /// Lower end of the 95 % Wilson interval of `grasp`.
    pub grasp_low: f64,
    /// Upper end.
    pub grasp_high: f64,
    /// Success at the last step.
    pub success: Option<f64>,
    /// Lower end of the 95 % Wilson interval of `success`.
    pub success_low: f64,
    /// Upper end.
    pub success_high: f64,
    /// Success at some step.
    pub success_any_step: Option<f64>,
    /// Success at the last step with the object let go.
    pub success_released: Option<f64>,
}

/// The difference of last-step success, `a` less `b`, averaged over tasks.
#[derive(Debug, Serialize)]
pub struct Paired {
    /// The strategy in question.
    pub a: String,
    /// The one that it is compared with.
    pub b: String,
    /// Of `a`.
    pub candidates: u32,
    /// Of `a`; `b` has the same unless it is greedy.
    pub temperature: f32,
    /// Pairs over all tasks.
    pub episodes: usize,
    /// The difference.
    pub gain: f64,
    /// Lower end of its 95 % bootstrap interval.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// The part of the way from one sample to the oracle.
#[derive(Debug, Serialize)]
pub struct Headroom {
    /// The strategy in question.
    pub strategy: String,
    /// Candidates per step, of the oracle, too.
    pub candidates: u32,
    /// Sampling temperature of all three.
    pub temperature: f32,
    /// 1 is as good as the oracle.
    pub fraction: f64,
}

impl ResultFile {
    /// The file's contents.
    pub fn new(results: &Results, versions: Value) -> ResultFile {
        let mut rows = Vec::new();
        for result in &results.settings {
            for (task, rates) in results.tasks.iter().zip(&result.tasks) {
                rows.push(row(&task.task, &task.variant, &result.setting, rates));
            }
            rows.push(row(AVERAGE, VARIANT_DEFAULT, &result.setting, &result.all));
        }
        let paired = results.gains.iter().map(|gain| Paired {
            a: gain.better.strategy.to_string(),
            b: gain.worse.strategy.to_string(),
            candidates: gain.better.candidates,
            temperature: gain.better.temperature,
            episodes: gain.gain.pairs,
            gain: gain.gain.mean,
            low: gain.gain.interval.low,
            high: gain.gain.interval.high,
        });
        let headroom = results.headroom.iter().map(|headroom| Headroom {
            strategy: headroom.setting.strategy.to_string(),
            candidates: headroom.setting.candidates,
            temperature: headroom.setting.temperature,
            fraction: headroom.fraction,
        });
        ResultFile {
            rows,
            paired: paired.collect(),
            headroom: headroom.collect(),
            decision_ms: results.decision_ms,
            step_ms: results.step_ms,
            simulator_ms: results.simulator_ms,
            versions,
        }
    }

    /// Writes the file.
    pub fn write(&self, path: &Path) -> Result<()> {
        let mut text = serde_json::to_string_pretty(self)?;
        text.push('\n');
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
    }
}

fn row(task: &str, variant: &str, setting: &Setting, rates: &Rates) -> Row {
    let value = |rate: Rate| rate.value();
    let (grasp, interval) = (rates.grasped.interval(), rates.success.interval());
    Row {
        task: task.to_owned(),
        variant: variant.to_owned(),
        strategy: setting.strategy.to_string(),
        candidates: setting.candidates,
        temperature: setting.temperature,
        episodes: rates.success.trials,
        faults: rates.faults,
        grasp: value(rates.grasped),
        grasp_low: grasp.low,
        grasp_high: grasp.high,
        success: value(rates.success),
        success_low: interval.low,
        success_high: interval.high,
        success_any_step: value(rates.ever_success),
        success_released: value(rates.released_success),
    }
}
