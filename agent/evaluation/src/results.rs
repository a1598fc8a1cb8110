//! The results of a run: rates of every setting on every task, gains between paired settings, headroom, decision time.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::Result;
use serde_json::Value;

use crate::statistics::{Gain, RESAMPLES, Rate, headroom_fraction, paired_bootstrap, quantile};
use decision::{Setting, Strategy, TaskId};
use store::run::{EpisodeSummary, FaultRecord};

/// Bootstraps are seeded, so that the same records always give the same tables.
const BOOTSTRAP_SEED: u64 = 0;

/// Everything that tables and figures show.
#[derive(Debug, Clone)]
pub struct Results {
    /// Tasks in the order of every table.
    pub tasks: Vec<TaskId>,
    /// One entry per setting, hottest temperature first.
    pub settings: Vec<SettingResult>,
    /// The comparisons that a verifier has to stand.
    pub gains: Vec<SettingGain>,
    /// How far each setting went from one sample to the oracle.
    pub headroom: Vec<SettingHeadroom>,
    /// From the observations to the chosen actions of a whole batch.
    pub decision_ms: Option<StepTime>,
    /// From an action to the next observation, with the server's other sessions before it.
    pub step_ms: Option<StepTime>,
    /// The part of it that the simulator itself took.
    pub simulator_ms: Option<StepTime>,
}

/// One setting on every task.
#[derive(Debug, Clone)]
pub struct SettingResult {
    /// The setting.
    pub setting: Setting,
    /// In the order of the tasks; no trials where the setting did not run.
    pub tasks: Vec<Rates>,
    /// All tasks together.
    pub all: Rates,
}

/// What is counted over episodes.
#[derive(Debug, Clone, Copy, Default)]
pub struct Rates {
    /// The object was held at some step.
    pub grasped: Rate,
    /// Success at the last step: SIMPLER's result.
    pub success: Rate,
    /// Success at some step.
    pub ever_success: Rate,
    /// Success at the last step with the object let go.
    pub released_success: Rate,
    /// Attempts that broke. They are in none of the rates.
    pub faults: u64,
}

/// The gain of one setting over another on the episodes that both have run.
#[derive(Debug, Clone)]
pub struct SettingGain {
    /// The setting in question.
    pub better: Setting,
    /// What it is compared with.
    pub worse: Setting,
    /// Difference of last-step success.
    pub gain: Gain,
}

/// The part of the way from one sample to the oracle that an setting has gone, at one temperature.
#[derive(Debug, Clone)]
pub struct SettingHeadroom {
    /// The setting in question.
    pub setting: Setting,
    /// 0: no better than one sample; 1: as good as the oracle with as many candidates.
    pub fraction: f64,
}

/// Milliseconds over all steps of all episodes; there is none without a step.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct StepTime {
    /// Median.
    pub p50: f64,
    /// 95 of 100 are faster.
    pub p95: f64,
}

type BySetting<'a> = Vec<(Setting, Vec<&'a EpisodeSummary>)>;

impl Results {
    /// Counts the episodes of a run and the attempts that broke; `order` are the run's tasks, see [`tasks_in_order`].
    pub fn new(
        summaries: &[EpisodeSummary],
        faults: &[FaultRecord],
        order: &[TaskId],
    ) -> Result<Results> {
        let mut by_setting: BySetting = Vec::new();
        for summary in summaries {
            of_setting(&mut by_setting, summary.identity.setting()?).push(summary);
        }
        let mut broken: Vec<(Setting, TaskId)> = Vec::new();
        for fault in faults {
            let setting = fault.identity.setting()?;
            // An setting of which every attempt broke still has its row.
            of_setting(&mut by_setting, setting);
            broken.push((setting, fault.identity.task_id()));
        }
        by_setting.sort_by(|(a, _), (b, _)| {
            let by_temperature = b.temperature.total_cmp(&a.temperature);
            by_temperature.then(a.strategy.cmp(&b.strategy)).then(a.candidates.cmp(&b.candidates))
        });
        let ran = summaries.iter().map(|summary| summary.identity.task_id());
        let tasks = in_order(ran.chain(broken.iter().map(|(_, task)| task.clone())), order);
        Ok(Results {
            gains: gains(&by_setting, &tasks),
            headroom: headroom(&by_setting),
            decision_ms: step_time(summaries, |summary| &summary.decision_ms),
            step_ms: step_time(summaries, |summary| &summary.step_ms),
            simulator_ms: step_time(summaries, |summary| &summary.simulator_ms),
            settings: by_setting
                .iter()
                .map(|(setting, list)| setting_result(*setting, list, &broken, &tasks))
                .collect(),
            tasks,
        })
    }
}

fn of_setting<'a, 'b>(
    by_setting: &'b mut BySetting<'a>,
    setting: Setting,
) -> &'b mut Vec<&'a EpisodeSummary> {
    let place = by_setting.iter().position(|(known, _)| *known == setting).unwrap_or_else(|| {
        by_setting.push((setting, Vec::new()));
        by_setting.len() - 1
    });
    &mut by_setting[place].1
}

/// The tasks that a run was asked for, from its options: the order of its tables.
pub fn tasks_in_order(options: &Value) -> Vec<TaskId> {
    let names = options["tasks"].as_array().map_or(&[][..], Vec::as_slice);
    names.iter().filter_map(|name| name.as_str()?.parse().ok()).collect()
}

/// Each task once: those of `order` first, then any others by name.
fn in_order(tasks: impl Iterator<Item = TaskId>, order: &[TaskId]) -> Vec<TaskId> {
    let mut tasks: BTreeSet<TaskId> = tasks.collect();
    let mut ordered: Vec<TaskId> = order.iter().filter_map(|task| tasks.take(task)).collect();
    ordered.extend(tasks);
    ordered
}

fn setting_result(
    setting: Setting,
    list: &[&EpisodeSummary],
    broken: &[(Setting, TaskId)],
    tasks: &[TaskId],
) -> SettingResult {
    let of_task = |task: &TaskId| {
        let faults =
            broken.iter().filter(|(other, name)| *other == setting && name == task).count();
        rates(
            list.iter().copied().filter(|summary| summary.identity.task_id() == *task),
            faults as u64,
        )
    };
    let faults = broken.iter().filter(|(other, _)| *other == setting).count();
    SettingResult {
        setting,
        tasks: tasks.iter().map(of_task).collect(),
        all: rates(list.iter().copied(), faults as u64),
    }
}

fn rates<'a>(summaries: impl Iterator<Item = &'a EpisodeSummary> + Clone, faults: u64) -> Rates {
    let of = |read: fn(&protocol::Statistics) -> bool| {
        Rate::of(summaries.clone().map(|summary| read(&summary.statistics)))
    };
    Rates {
        grasped: of(|statistics| statistics.ever_grasped),
        success: of(|statistics| statistics.is_success),
        ever_success: of(|statistics| statistics.ever_success),
        released_success: of(|statistics| statistics.released_success),
        faults,
    }
}

/// The verifier against everything that costs less to have, and with agreement against agreement alone.
fn gains(by_setting: &BySetting, tasks: &[TaskId]) -> Vec<SettingGain> {
    let is_verifier = |setting: &Setting| {
        matches!(setting.strategy, Strategy::Verifier | Strategy::VerifierMedoid)
    };
    let mut gains = Vec::new();
    for (better, ours) in by_setting.iter().filter(|(setting, _)| is_verifier(setting)) {
        for (worse, theirs) in by_setting {
            let same_temperature = worse.temperature == better.temperature;
            let is_compared = match worse.strategy {
                Strategy::Greedy => true,
                Strategy::Sample => same_temperature,
                Strategy::FirstWellFormed
                | Strategy::Majority
                | Strategy::Medoid
                | Strategy::Worst => same_temperature && worse.candidates == better.candidates,
                Strategy::Verifier => {
                    better.strategy == Strategy::VerifierMedoid
                        && same_temperature
                        && worse.candidates == better.candidates
                }
                Strategy::VerifierMedoid | Strategy::Oracle => false,
            };
            if is_compared && let Some(gain) = gain(ours, theirs, tasks) {
                gains.push(SettingGain { better: *better, worse: *worse, gain });
            }
        }
    }
    gains
}

/// None when some task of the run has no pair yet: an average over other tasks would be another quantity.
fn gain(ours: &[&EpisodeSummary], theirs: &[&EpisodeSummary], tasks: &[TaskId]) -> Option<Gain> {
    let place = |summary: &EpisodeSummary| {
        let identity = &summary.identity;
        (identity.task.clone(), identity.variant.clone(), identity.episode)
    };
    let theirs: BTreeMap<_, f64> =
        theirs.iter().map(|summary| (place(summary), success(summary))).collect();
    let of_task = |task: &TaskId| {
        let ours = ours.iter().filter(|summary| summary.identity.task_id() == *task);
        let pair =
            |summary: &&EpisodeSummary| Some(success(summary) - theirs.get(&place(summary))?);
        ours.filter_map(pair).collect()
    };
    let differences: Vec<Vec<f64>> = tasks.iter().map(of_task).collect();
    paired_bootstrap(&differences, RESAMPLES, BOOTSTRAP_SEED)
}

fn headroom(by_setting: &BySetting) -> Vec<SettingHeadroom> {
    let value = |strategy: Strategy, candidates: u32, temperature: f32| {
        let setting = Setting { strategy, candidates, temperature };
        let (_, list) = by_setting.iter().find(|(known, _)| *known == setting)?;
        Rate::of(list.iter().map(|summary| summary.statistics.is_success)).value()
    };
    let mut headroom = Vec::new();
    for (setting, _) in by_setting {
        let Setting { strategy, candidates, temperature } = *setting;
        if matches!(strategy, Strategy::Greedy | Strategy::Sample | Strategy::Oracle) {
            continue;
        }
        let fraction = value(Strategy::Sample, 1, temperature)
            .zip(value(strategy, candidates, temperature))
            .zip(value(Strategy::Oracle, candidates, temperature))
            .and_then(|((sample, chosen), oracle)| headroom_fraction(sample, chosen, oracle));
        if let Some(fraction) = fraction {
            headroom.push(SettingHeadroom { setting: *setting, fraction });
        }
    }
    headroom
}

fn success(summary: &EpisodeSummary) -> f64 {
    f64::from(u8::from(summary.statistics.is_success))
}

fn step_time(
    summaries: &[EpisodeSummary],
    of: fn(&EpisodeSummary) -> &Vec<f32>,
) -> Option<StepTime> {
    let all = summaries.iter().flat_map(of);
    let mut all: Vec<f64> = all.map(|milliseconds| f64::from(*milliseconds)).collect();
    all.sort_by(f64::total_cmp);
    (!all.is_empty()).then(|| StepTime { p50: quantile(&all, 0.50), p95: quantile(&all, 0.95) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::Statistics;
    use store::record::EpisodeIdentity;

    const TASKS: [&str; 2] = ["widowx_spoon_on_towel", "widowx_carrot_on_plate"];

    fn order() -> Vec<TaskId> {
        TASKS.map(TaskId::default_of).to_vec()
    }

    fn identity(task: &str, episode: u32, strategy: Strategy) -> EpisodeIdentity {
        let setting = Setting::new(strategy, 5, 1.0);
        EpisodeIdentity {
            run: "run".into(),
            task: task.into(),
            variant: "default".into(),
            layout: None,
            episode,
            seed: 3_000_000_000,
            sampling_seed: 1,
            strategy: setting.strategy.to_string(),
            candidates: setting.candidates,
            temperature: setting.temperature,
        }
    }

    fn summary(task: &str, episode: u32, strategy: Strategy, is_success: bool) -> EpisodeSummary {
        EpisodeSummary {
            identity: identity(task, episode, strategy),
            statistics: Statistics { is_success, ever_grasped: true, ..Statistics::default() },
            simulator: "made up".into(),
            steps: 2,
            held_steps: 0,
            malformed: 0,
            candidates: 2,
            wall_secs: 1.0,
            decision_ms: vec![10.0, 20.0],
            batch_size: vec![4, 8],
            step_ms: vec![6.0, 6.0],
            simulator_ms: vec![],
        }
    }

    /// Sample solves a quarter, the verifier half, the oracle all of eight episodes on two tasks.
    fn made_up() -> Vec<EpisodeSummary> {
        let mut all = Vec::new();
        for task in [TASKS[1], TASKS[0]] {
            for episode in 0..4 {
                all.push(summary(task, episode, Strategy::Sample, episode < 1));
                all.push(summary(task, episode, Strategy::Verifier, episode < 2));
                all.push(summary(task, episode, Strategy::Oracle, true));
            }
        }
        all
    }

    #[test]
    fn rates_gains_and_headroom_of_known_outcomes() {
        let results = Results::new(&made_up(), &[], &order()).expect("results");
        assert_eq!(results.tasks, order(), "the order of the options");
        let strategies: Vec<_> =
            results.settings.iter().map(|setting| setting.setting.strategy).collect();
        assert_eq!(strategies, [Strategy::Sample, Strategy::Verifier, Strategy::Oracle]);
        assert_eq!(results.settings[0].all.success, Rate { successes: 2, trials: 8 });
        assert_eq!(results.settings[1].tasks[0].success, Rate { successes: 2, trials: 4 });
        let [gain] = &results.gains[..] else { panic!("one comparison: {:?}", results.gains) };
        assert_eq!(
            (gain.better.strategy, gain.worse.strategy),
            (Strategy::Verifier, Strategy::Sample)
        );
        assert_eq!((gain.gain.mean, gain.gain.pairs), (0.25, 8));
        let [headroom] = &results.headroom[..] else {
            panic!("one setting: {:?}", results.headroom)
        };
        assert!((headroom.fraction - 1.0 / 3.0).abs() < 1e-12);
        assert_eq!(results.decision_ms.map(|time| time.p50), Some(15.0));
        assert_eq!(results.step_ms.map(|time| time.p95), Some(6.0));
        assert_eq!(results.simulator_ms, None, "no simulator said what it took");
    }

    #[test]
    fn a_fault_is_counted_and_changes_no_rate() {
        let fault = FaultRecord {
            identity: identity(TASKS[0], 7, Strategy::Sample),
            attempt: 1,
            server: "s".into(),
            reason: "lost".into(),
            never_acted: false,
        };
        let results = Results::new(&made_up(), &[fault], &order()).expect("results");
        assert_eq!(results.settings[0].tasks[0].faults, 1);
        assert_eq!(results.settings[0].tasks[1].faults, 0);
        assert_eq!(results.settings[0].all.success, Rate { successes: 2, trials: 8 });
    }

    #[test]
    fn only_common_episodes_are_paired() {
        let mut summaries = made_up();
        summaries.push(summary(TASKS[0], 9, Strategy::Verifier, true));
        let results = Results::new(&summaries, &[], &order()).expect("results");
        assert_eq!(results.gains[0].gain.pairs, 8);
        // Without any pair in one task there is no average over all tasks.
        summaries.retain(|one| {
            one.identity.task != TASKS[1] || one.identity.strategy != Strategy::Sample.name()
        });
        assert!(Results::new(&summaries, &[], &order()).expect("results").gains.is_empty());
    }
}
