//! The whole loop with the shipped models: four tasks, two strategies, real servers.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::Stdio;
use std::sync::OnceLock;

use serde_json::Value;
use store::record::EpisodeRecord;

use crate::evaluation::{Evaluation, WAIT, is_alive, kill};
use crate::harness::{python, rever, run, succeed, text, wait_for};
use crate::server::{Server, free_endpoint, open_router};

/// One episode per task and strategy. The longest task takes twice as long as the others, so that
/// some episodes are recorded while others are still running.
const ARGUMENTS: [&str; 6] = [
    "--strategies=sample,verifier",
    "--candidates=3",
    "--episodes=1",
    "--layouts=random",
    "--seed=7",
    "--sessions=8",
];
/// SIMPLER's WidowX tasks, which our servers offer.
const TASKS: usize = 4;
const EPISODES: usize = TASKS * 2;
/// The digest of these episodes as computed at commit 091f8b1, before the decider was a separate
/// crate.
const DIGEST: &str = "4e7a574af4e1588ace47dbf25ef943f96de6ab3ab99f82b140cbd02ed5681cad";

/// An undisturbed run, made once for all tests that compare with it.
fn undisturbed() -> &'static (Evaluation, Value) {
    static RUN: OnceLock<(Evaluation, Value)> = OnceLock::new();
    RUN.get_or_init(|| {
        let evaluation = Evaluation::new(&fresh_folder("undisturbed"), &ARGUMENTS);
        let result = evaluation.finish();
        (evaluation, result)
    })
}

/// A folder that is emptied at the start of the test and kept afterwards for inspection.
fn fresh_folder(name: &str) -> std::path::PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    if folder.exists() {
        std::fs::remove_dir_all(&folder).expect("the last run's files can be removed");
    }
    std::fs::create_dir_all(&folder).expect("a folder can be made");
    folder
}

#[test]
fn every_episode_leaves_a_record_and_a_label() {
    let (evaluation, _) = undisturbed();
    let records = evaluation.records();
    assert_eq!(records.len(), EPISODES);
    for (id, record) in &records {
        assert_eq!(record.steps.len(), steps_max(&record.identity.task), "{id}");
        let candidates = if record.identity.strategy == "sample" { 1 } else { 3 };
        for step in &record.steps {
            let decision = step.decision.as_ref().expect("a decision in every step");
            let all = &decision.candidates;
            assert_eq!(all.len(), candidates, "{id}");
            let scored = all.iter().filter(|candidate| candidate.score.is_some());
            let expected = all.iter().filter(|candidate| candidate.actions.is_some());
            if candidates > 1 {
                assert_eq!(scored.count(), expected.count(), "{id}: the well-formed are scored");
            }
        }
    }
    assert_eq!(labelled(evaluation), records.keys().cloned().collect());
}

#[test]
fn the_course_of_episodes_never_changes() {
    let (evaluation, _) = undisturbed();
    let said = succeed(rever().arg("digest").arg(evaluation.run_folder()));
    assert_eq!(said, format!("{DIGEST} {EPISODES} episodes\n"));
}

#[test]
fn the_result_file_has_the_documented_shape() {
    let (_, result) = undisturbed();
    let parts = [
        "batch_size",
        "decision_ms",
        "headroom",
        "options",
        "paired",
        "rows",
        "run",
        "simulator_ms",
        "starts",
        "step_ms",
        "versions",
    ];
    assert_eq!(keys(result), parts);
    for time in ["decision_ms", "step_ms", "simulator_ms"] {
        assert_eq!(keys(&result[time]), ["p50", "p95"], "{time}");
    }
    let p50 = |time: &str| result[time]["p50"].as_f64().expect("a number");
    assert!(0.0 < p50("simulator_ms") && p50("simulator_ms") < p50("step_ms"), "{result}");
    let rows = result["rows"].as_array().expect("rows");
    // For each strategy: one per task and one for all tasks.
    assert_eq!(rows.len(), (TASKS + 1) * 2);
    for row in rows {
        for key in ["task", "variant", "strategy"] {
            assert!(row[key].is_string(), "{key} in {row}");
        }
        for key in ["candidates", "episodes", "starts", "faults", "malformed", "held_steps"] {
            assert!(row[key].is_u64(), "{key} in {row}");
        }
        for key in ["grasp", "grasp_low", "grasp_high", "success", "success_low", "success_high"] {
            assert!(
                row[key].as_f64().is_some_and(|rate| (0.0..=1.0).contains(&rate)),
                "{key} in {row}"
            );
        }
    }
    let paired = result["paired"].as_array().expect("paired");
    let gain = paired.iter().find(|pair| pair["a"] == "verifier" && pair["b"] == "sample");
    let gain = gain.expect("the verifier is compared with a single sample");
    assert_eq!(gain["episodes"], TASKS);
    assert!(["gain", "low", "high"].iter().all(|key| gain[*key].is_f64()), "{gain}");
}

#[test]
fn a_killed_run_is_resumed() {
    let (undisturbed, expected) = undisturbed();
    let evaluation = Evaluation::new(&fresh_folder("killed"), &ARGUMENTS);
    let mut running = evaluation.start();
    evaluation.wait_for_records(&mut running, 1);
    let servers = running.servers();
    assert!(!servers.is_empty());
    running.kill();
    wait_for("the end of the servers of a killed agent", WAIT, || {
        (!servers.iter().copied().any(is_alive)).then_some(())
    });
    let before = evaluation.record_files();
    assert!((1..EPISODES).contains(&before.len()), "killed in the middle, with {}", before.len());

    let result = evaluation.finish();
    let after = evaluation.record_files();
    assert!(before.iter().all(|(name, bytes)| after.get(name) == Some(bytes)), "none is run again");
    assert_same_episodes(&evaluation, undisturbed);
    assert_eq!((&result["rows"], &result["paired"]), (&expected["rows"], &expected["paired"]));
}

#[test]
fn episodes_of_a_killed_server_are_run_again_and_leave_one_label() {
    let (undisturbed, _) = undisturbed();
    let evaluation =
        Evaluation::new(&fresh_folder("fault"), &[&ARGUMENTS[..], &["--servers=1"]].concat());
    let mut running = evaluation.start();
    // The short episodes are recorded, so the long ones are still running.
    evaluation.wait_for_records(&mut running, 1);
    let [server] = running.servers()[..] else { panic!("one server was asked for") };
    kill(server);
    assert!(running.succeeds(), "{}", evaluation.words());

    let faults = store::run::faults(&evaluation.run_folder()).expect("a list of faults");
    assert!(!faults.is_empty(), "no episode broke: {}", evaluation.words());
    let result = evaluation.finish();
    let averages = result["rows"].as_array().expect("rows").iter();
    let counted = averages.filter(|row| row["task"] == "average").map(|row| row["faults"].as_u64());
    assert_eq!(counted.sum::<Option<u64>>(), Some(faults.len() as u64), "faults are counted");
    assert_same_episodes(&evaluation, undisturbed);
    assert_eq!(labelled(&evaluation), evaluation.records().keys().cloned().collect());
}

#[test]
fn the_report_shows_every_episode() {
    let (evaluation, _) = undisturbed();
    let out = fresh_folder("report");
    succeed(rever().arg("report").arg(evaluation.run_folder()).arg("--out").arg(&out));
    let page = std::fs::read_to_string(out.join("index.html")).expect("a page");
    assert!(!page.contains("http://") && !page.contains("https://"), "it opens offline");
    let mut written = String::new();
    collect_text(&out, &mut written);
    for id in evaluation.records().keys() {
        assert!(written.contains(id.as_str()), "{id} is in the report");
    }
}

#[test]
fn a_reader_that_closes_the_pipe_is_no_error() {
    let (evaluation, _) = undisturbed();
    let out = fresh_folder("unread");
    let mut report = rever();
    report.arg("report").arg(evaluation.run_folder()).arg("--out").arg(&out);
    let mut child = report.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("it runs");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("it ends");
    assert!(out.join("index.html").exists(), "the page is made");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!said.contains("panicked"), "{said}");
}

#[test]
fn doctor_finds_everything_that_a_run_needs() {
    let folder = fresh_folder("doctor");
    let mut doctor = rever();
    doctor.current_dir(&folder).args(["doctor", "--json", "findings.json", "--python"]);
    let said = succeed(doctor.arg(&python().python));
    assert!(said.contains("ready: try `rever demo`"), "{said}");
    let json = std::fs::read(folder.join("findings.json")).expect("a file of findings");
    let findings: Value = serde_json::from_slice(&json).expect("it is JSON");
    let names = findings.as_array().expect("a list").iter().map(|finding| {
        assert_eq!(finding["is_ok"], true, "{finding}");
        finding["name"].as_str().expect("a name")
    });
    let expected =
        ["python", "rendering", "simulator", "policy", "verifier", "environment", "decision"];
    assert_eq!(names.collect::<Vec<_>>(), expected);
}

#[test]
fn doctor_names_what_is_missing_and_fails() {
    let nobody = free_endpoint();
    let output = run(rever().args(["doctor", "--connect", &nobody]));
    let said = text(&output);
    assert!(!output.status.success(), "{said}");
    assert!(
        said.contains("FAULT environment") && said.contains("not ready: environment"),
        "{said}"
    );
}

#[test]
fn servers_on_other_machines_are_reached_through_a_router() {
    let (undisturbed, _) = undisturbed();
    let endpoint = free_endpoint();
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let router = runtime.block_on(open_router(&endpoint));
    let _servers = [(); 2].map(|()| Server::start_behind_router(&endpoint, "elsewhere", &[]));
    let there = ["--fleet=elsewhere", &format!("--connect={endpoint}")];
    succeed(rever().arg("doctor").args(there));
    let evaluation =
        Evaluation::new(&fresh_folder("elsewhere"), &[&ARGUMENTS[..], &there].concat());
    evaluation.finish();
    assert_same_episodes(&evaluation, undisturbed);
    runtime.block_on(async { router.close().await }).expect("the router closes");
}

#[test]
fn a_failed_reset_is_repeated_and_a_server_without_the_task_is_not_used() {
    let endpoint = free_endpoint();
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let router = runtime.block_on(open_router(&endpoint));
    let _stranger =
        Server::start_behind_router(&endpoint, "mixed", &["--gymnasium", "CartPole-v1"]);
    let _ours = Server::start_broken_behind_router(&endpoint, "mixed", "breaks_first_reset");
    let arguments = [
        "--fleet=mixed",
        &format!("--connect={endpoint}"),
        "--tasks=widowx_spoon_on_towel",
        "--strategies=sample",
        "--layouts=random",
        "--seed=7",
        "--episodes=2",
        // No other episode runs while the reset fails.
        "--sessions=1",
    ];
    let evaluation = Evaluation::new(&fresh_folder("mixed"), &arguments);
    assert!(evaluation.start().succeeds(), "{}", evaluation.words());
    assert_eq!(evaluation.records().len(), 2);
    let faults = store::run::faults(&evaluation.run_folder()).expect("a list");
    assert_eq!(faults.len(), 1, "{faults:?}");
    assert!(faults[0].reason.contains("made up"), "{faults:?}");
    runtime.block_on(async { router.close().await }).expect("the router closes");
}

/// Same candidates, choices and outcomes; run names and times differ.
fn assert_same_episodes(ours: &Evaluation, theirs: &Evaluation) {
    let (ours, theirs) = (ours.records(), theirs.records());
    assert!(ours.keys().eq(theirs.keys()));
    for (id, record) in &ours {
        let other = &theirs[id];
        let steps = |record: &EpisodeRecord| {
            let mut steps = record.steps.clone();
            for step in &mut steps {
                (step.step_ms, step.simulator_ms) = (0.0, 0.0);
                if let Some(decision) = &mut step.decision {
                    (decision.batch_ms, decision.batch_size) = (0.0, 1);
                }
            }
            steps
        };
        assert_eq!(record.statistics, other.statistics, "{id}");
        assert!(steps(record) == steps(other), "{id}: the same seeds give the same episode");
    }
}

/// The ids of all labels; each one occurs once.
fn labelled(evaluation: &Evaluation) -> BTreeSet<String> {
    let labels = store::labels::labels(&evaluation.labels()).expect("its labels");
    let ids: BTreeSet<String> = labels.iter().map(|label| label.id.clone()).collect();
    assert_eq!(ids.len(), labels.len(), "a label is there twice");
    ids
}

/// An episode lasts as long as its task's horizon, with or without success.
fn steps_max(task: &str) -> usize {
    if task == "widowx_put_eggplant_in_basket" { 120 } else { 60 }
}

fn keys(value: &Value) -> Vec<&str> {
    value.as_object().expect("an object").keys().map(String::as_str).collect()
}

fn collect_text(folder: &Path, into: &mut String) {
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        into.push_str(&path.to_string_lossy());
        if path.is_dir() {
            collect_text(&path, into);
        } else if let Ok(text) = std::fs::read_to_string(&path) {
            into.push_str(&text);
        }
    }
}
