//! Tests of results on synthetic runs with known figures.

use decision::Strategy;
use serde_json::json;
use store::queue::FaultScope;
use store::record::EpisodeIdentity;

use super::*;
use crate::comparisons::DEFAULT_SETTING;
use crate::headline::Headline;
use crate::result_file::{AVERAGE, ResultFile};
use crate::statistics::wilson;

const TASKS: [&str; 2] = ["widowx_spoon_on_towel", "widowx_carrot_on_plate"];

fn order() -> Vec<TaskId> {
    TASKS.map(TaskId::default_of).to_vec()
}

fn identity(task: &TaskId, episode: u32, setting: Setting) -> EpisodeIdentity {
    EpisodeIdentity {
        run: "run".into(),
        task: task.task.clone(),
        variant: task.variant.clone(),
        layout: None,
        episode,
        seed: 3_000_000_000 + u64::from(episode),
        sampling_seed: 1000 + u64::from(episode),
        strategy: setting.strategy.to_string(),
        candidates: setting.candidates,
        temperature: setting.temperature,
    }
}

fn setting(strategy: Strategy) -> Setting {
    Setting::new(strategy, 5, 1.0)
}

fn summary_of(task: &TaskId, episode: u32, setting: Setting, is_success: bool) -> EpisodeSummary {
    EpisodeSummary {
        identity: identity(task, episode, setting),
        statistics: Statistics { is_success, ever_grasped: true, ..Statistics::default() },
        simulator: "made up".into(),
        steps: 2,
        held_steps: 0,
        malformed: 1,
        candidates: 2 * setting.candidates,
        wall_secs: 1.0,
        decision_ms: vec![10.0, 20.0],
        batch_size: vec![4, 8],
        step_ms: vec![6.0, 6.0],
        simulator_ms: vec![5.0, 4.0],
    }
}

fn summary(task: &str, episode: u32, strategy: Strategy, is_success: bool) -> EpisodeSummary {
    summary_of(&TaskId::default_of(task), episode, setting(strategy), is_success)
}

/// On a fixed layout instead of a random one.
fn on_layout(mut summary: EpisodeSummary, layout: u32) -> EpisodeSummary {
    summary.identity.layout = Some(layout);
    summary
}

/// Eight episodes on two tasks: a single sample solves a quarter, the verifier half, the oracle all.
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

fn fault(strategy: Strategy, episode: u32, attempt: u32) -> FaultRecord {
    FaultRecord {
        identity: identity(&TaskId::default_of(TASKS[0]), episode, setting(strategy)),
        attempt,
        server: "s".into(),
        scope: FaultScope::Server,
        reason: "lost".into(),
    }
}

fn results(summaries: &[EpisodeSummary]) -> Results {
    Results::new(summaries, &[], &order()).expect("results")
}

#[test]
fn rates_gains_and_headroom_of_known_outcomes() {
    let results = results(&made_up());
    assert_eq!(results.tasks, order(), "the order of the options");
    let strategies: Vec<_> = results.settings.iter().map(|one| one.setting.strategy).collect();
    assert_eq!(strategies, [Strategy::Sample, Strategy::Verifier, Strategy::Oracle]);
    let sample = results.settings[0].all.success;
    assert_eq!((sample.value, sample.episodes, sample.starts), (Some(0.25), 8, 8));
    let verifier = results.settings[1].tasks[0].success;
    assert_eq!((verifier.value, verifier.episodes), (Some(0.5), 4));
    assert!((verifier.interval.low - wilson(0.5, 4.0).low).abs() < 1e-12);
    let [gain] = &results.gains[..] else { panic!("one comparison: {:?}", results.gains) };
    assert_eq!((gain.better.strategy, gain.worse.strategy), (Strategy::Verifier, Strategy::Sample));
    assert_eq!((gain.gain.mean, gain.gain.pairs), (0.25, 8));
    let [headroom] = &results.headroom[..] else { panic!("one setting: {:?}", results.headroom) };
    assert!((headroom.headroom.fraction - 1.0 / 3.0).abs() < 1e-12);
    assert_eq!(headroom.headroom.episodes, 8);
    let interval = headroom.headroom.interval.expect("the oracle is clearly better");
    assert!(interval.contains(1.0 / 3.0) && interval.high - interval.low > 0.2, "{interval:?}");
}

#[test]
fn times_are_those_of_one_decision_with_the_size_of_its_batch() {
    let results = results(&made_up());
    assert_eq!(results.decision_ms.map(|time| time.p50), Some(15.0));
    assert_eq!(results.batch_size, Some(6.0));
    assert_eq!(results.step_ms.map(|time| time.p95), Some(6.0));
    assert_eq!(results.simulator_ms.map(|time| time.p50), Some(4.5));
    assert_eq!(Results::new(&[], &[], &[]).expect("results").decision_ms, None);
}

#[test]
fn faults_and_episodes_without_any_action_are_counted_and_change_no_rate() {
    let mut summaries = made_up();
    let mut held = summary(TASKS[0], 8, Strategy::Sample, false);
    (held.held_steps, held.malformed) = (2, 2);
    summaries.push(held);
    let faults = [fault(Strategy::Sample, 7, 1), fault(Strategy::Sample, 6, 1)];
    let results = Results::new(&summaries, &faults, &order()).expect("results");
    let [sample, other] = [&results.settings[0].tasks[0], &results.settings[0].tasks[1]];
    assert_eq!((sample.success.value, sample.success.episodes), (Some(0.25), 4));
    assert_eq!((sample.counts.faults, sample.counts.never_acted), (2, 1));
    assert_eq!((other.counts.faults, other.counts.never_acted), (0, 0));
    assert_eq!(results.counted.len(), 24);
}

#[test]
fn malformed_candidates_and_held_steps_are_counted_per_setting() {
    let mut summaries = made_up();
    summaries[0].held_steps = 1;
    let results = results(&summaries);
    let counts = results.settings[0].all.counts;
    assert_eq!((counts.malformed, counts.proposed), (8, 16));
    assert_eq!((counts.held_steps, counts.decisions), (1, 16));
    let counts = results.settings[1].tasks[0].counts;
    assert_eq!((counts.malformed, counts.proposed, counts.held_steps), (4, 40, 0));
}

#[test]
fn repeats_of_a_deterministic_episode_count_once() {
    // 24 fixed layouts, each run three times: the episodes differ only in their numbers.
    let of = |strategy: Strategy, episode: u32| {
        let is_success = (episode % 24) < 4;
        on_layout(summary(TASKS[0], episode, strategy, is_success), episode % 24)
    };
    let once: Vec<EpisodeSummary> = (0..24).map(|episode| of(Strategy::Greedy, episode)).collect();
    let thrice: Vec<EpisodeSummary> =
        (0..72).map(|episode| of(Strategy::Greedy, episode)).collect();
    let (once, thrice) = (results(&once), results(&thrice));
    let rate = thrice.settings[0].all.success;
    assert_eq!(rate, once.settings[0].all.success);
    assert_eq!((rate.episodes, rate.starts), (24, 24));
    assert_eq!(thrice.settings[0].all.counts.repeats, 48);
    assert!(thrice.counted.contains("widowx_spoon_on_towel-default-0000-greedy-n1-t0"));
    // Sampled episodes of one layout differ, but there are still only 24 layouts.
    let sampled: Vec<EpisodeSummary> =
        (0..72).map(|episode| of(Strategy::Sample, episode)).collect();
    let sampled = results(&sampled).settings[0].all;
    assert_eq!((sampled.success.episodes, sampled.success.starts), (72, 24));
    assert_eq!(sampled.counts.repeats, 0);
    assert!((sampled.success.interval.low - rate.interval.low).abs() < 1e-12, "all are alike");
}

#[test]
fn a_deterministic_episode_is_paired_with_every_sampled_one_of_its_layout() {
    let mut summaries = Vec::new();
    for episode in 0..9 {
        let layout = episode % 3;
        let verifier = summary(TASKS[0], episode, Strategy::Verifier, episode < 6);
        summaries.push(on_layout(verifier, layout));
        summaries
            .push(on_layout(summary(TASKS[0], episode, Strategy::Greedy, layout == 0), layout));
    }
    let results = results(&summaries);
    let [gain] = &results.gains[..] else { panic!("one comparison: {:?}", results.gains) };
    assert_eq!(gain.worse.strategy, Strategy::Greedy);
    assert!((gain.gain.mean - (2.0 / 3.0 - 1.0 / 3.0)).abs() < 1e-12);
    assert_eq!((gain.gain.pairs, gain.gain.starts), (9, 3));
}

#[test]
fn only_common_episodes_are_paired() {
    let mut summaries = made_up();
    summaries.push(summary(TASKS[0], 9, Strategy::Verifier, true));
    let of_common = results(&summaries);
    assert_eq!(of_common.gains[0].gain.pairs, 8);
    // Headroom is also computed over common episodes only, not from rates over different ones.
    let expected = results(&made_up()).headroom;
    assert_eq!(of_common.headroom, expected);
    // If a task has no pair, there is no average over all tasks.
    summaries.retain(|one| {
        one.identity.task != TASKS[1] || one.identity.strategy != Strategy::Sample.name()
    });
    let without = results(&summaries);
    assert!(without.gains.is_empty() && without.headroom.is_empty());
    assert_eq!(without.settings[0].all.success.value, None);
}

#[test]
fn a_partial_run_has_one_definition_of_average() {
    // Seven episodes of one task and four of the other: the gain is still the difference of the rates.
    let mut summaries = made_up();
    for episode in 4..7 {
        summaries.push(summary(TASKS[0], episode, Strategy::Sample, true));
        summaries.push(summary(TASKS[0], episode, Strategy::Verifier, true));
    }
    let results = results(&summaries);
    let [sample, verifier] = [0, 1].map(|index| results.settings[index].all.success.value);
    assert_eq!(sample, Some((4.0 / 7.0 + 0.25) / 2.0));
    let gain = &results.gains[0].gain;
    let difference = verifier.expect("a rate") - sample.expect("a rate");
    assert!((gain.mean - difference).abs() < 1e-12);
    assert!((gain.mean - (gain.better_rate - gain.worse_rate)).abs() < 1e-12);
}

#[test]
fn variants_are_tasks_of_their_own() {
    let wide = TaskId::new(TASKS[0], "distractors");
    let mut summaries = made_up();
    for episode in 0..4 {
        summaries.push(summary_of(&wide, episode, setting(Strategy::Verifier), false));
    }
    let order = tasks_in_order(&json!({
        "tasks": ["widowx_carrot_on_plate", "widowx_spoon_on_towel/distractors", "widowx_stack_cube"]
    }));
    let results = Results::new(&summaries, &[], &order).expect("results");
    let expected = [TaskId::default_of(TASKS[1]), wide, TaskId::default_of(TASKS[0])];
    assert_eq!(results.tasks, expected, "the options' order, then any others by name");
    let verifier = &results.settings[1];
    let rates = verifier.tasks.iter().map(|task| task.success.value.expect("a rate"));
    assert_eq!(rates.collect::<Vec<_>>(), [0.5, 0.0, 0.5]);
    let file = ResultFile::new(&results, json!({})).expect("a file");
    let row = file.rows.iter().find(|row| row.variant == "distractors" && row.candidates == 5);
    assert_eq!(row.map(|row| (row.task.as_str(), row.success)), Some((TASKS[0], Some(0.0))));
}

#[test]
fn the_first_well_formed_candidate_is_a_baseline() {
    let mut summaries = made_up();
    for task in TASKS {
        for episode in 0..4 {
            summaries.push(summary(task, episode, Strategy::FirstWellFormed, episode < 2));
        }
    }
    let results = results(&summaries);
    let gains: Vec<(Strategy, Strategy, f64)> = results
        .gains
        .iter()
        .map(|gain| (gain.better.strategy, gain.worse.strategy, gain.gain.mean))
        .collect();
    let expected = [
        (Strategy::FirstWellFormed, Strategy::Sample, 0.25),
        (Strategy::Verifier, Strategy::Sample, 0.25),
        (Strategy::Verifier, Strategy::FirstWellFormed, 0.0),
    ];
    assert_eq!(gains, expected);
}

#[test]
fn the_headline_names_the_default_setting_and_what_is_open() {
    let task = TaskId::default_of(TASKS[0]);
    let mut summaries = Vec::new();
    for episode in 0..6 {
        let mut add = |strategy, candidates, is_success| {
            let setting = Setting::new(strategy, candidates, 1.0);
            summaries.push(summary_of(&task, episode, setting, is_success));
        };
        add(Strategy::Sample, 1, episode < 2);
        add(Strategy::Verifier, 2, episode < 3);
        add(Strategy::Verifier, 5, episode < 6);
        add(Strategy::Verifier, 8, episode < 1);
    }
    let main = results(&summaries).main_gain().cloned().expect("a comparison");
    assert_eq!(main.better, DEFAULT_SETTING);
    let text = Headline::new(&results(&summaries)).expect("a headline").text();
    assert!(
        text.starts_with("The verifier's choice among 5 candidates (T=1) succeeds in 100.0 %"),
        "{text}"
    );
    assert!(text.contains("a single sample in 33.3 %: +66.7 percentage points"), "{text}");
    assert!(text.contains("6 pairs). The verifier is better."), "{text}");
    summaries.retain(|one| one.identity.candidates < 5);
    let text = Headline::new(&results(&summaries)).expect("a headline").text();
    assert!(text.contains("among 2 candidates"), "the nearest that there is: {text}");
    assert!(text.contains("Not clear yet: the interval includes 0. About "), "{text}");
    summaries.retain(|one| one.identity.candidates < 2);
    let text = Headline::new(&results(&summaries)).expect("a headline").text();
    let expected = "A single sample (sample T=1) succeeds in 33.3 % of episodes (95 % interval 9.7 to 70.0, 6 episodes).";
    assert_eq!(text.trim(), expected);
}

#[test]
fn the_result_file_says_what_it_was_made_from() {
    let made_from = json!({
        "run": "evaluate-1234",
        "options": {"seed": 0, "layouts": "grid"},
        "versions": {"policy": "cafe"},
        "command": ["rever", "evaluate"],
        "commit": "f6e7bf2",
        "date": "2026-11-30",
    });
    let file = ResultFile::new(&results(&made_up()), made_from.clone()).expect("a file");
    let written = serde_json::to_value(&file).expect("JSON");
    for (name, value) in made_from.as_object().expect("an object") {
        assert_eq!(&written[name], value, "{name}");
    }
    let rows = written["rows"].as_array().expect("rows");
    let average = rows.iter().find(|row| row["task"] == AVERAGE && row["strategy"] == "verifier");
    let average = average.expect("an average");
    let counts = ["malformed", "proposed", "held_steps", "decisions", "never_acted", "repeats"];
    let found = counts.map(|name| average[name].as_u64().expect(name));
    assert_eq!(found, [8, 80, 0, 16, 0, 0]);
    assert_eq!((&average["episodes"], &average["starts"]), (&json!(8), &json!(8)));
    assert_eq!(written["batch_size"], 6.0);
    assert!(ResultFile::new(&results(&made_up()), json!("text")).is_err());
}
