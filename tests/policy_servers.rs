//! Policy servers as policies: the served agent equals the local one, and servers made of the peers'
//! own packages execute the same chunks.

use std::path::Path;
use std::process::Command;

use store::record::{CandidateRecord, DecisionRecord, EpisodeRecord};

use crate::evaluation::Evaluation;
use crate::harness::{ReadyProgram, peers, python, repository, rever, run, text};

const TASK: &str = "widowx_stack_cube";
/// Actions of a chunk.
const CHUNK: usize = 3;

/// `rever serve-policy` of the included policy.
fn of_rever() -> ReadyProgram {
    let mut command = rever();
    command.args(["serve-policy", "--listen", "127.0.0.1:0", "--strategy", "greedy"]);
    ReadyProgram::start(command)
}

/// A policy behind a peer's own server.
fn of_peer(wire: &str) -> ReadyProgram {
    let mut command = peers().command();
    command.arg(repository().join("tests/policy_server.py")).args([wire, &CHUNK.to_string()]);
    ReadyProgram::start(command)
}

/// Host and port.
fn place(server: &ReadyProgram) -> String {
    let place = server.name.trim_start_matches("ws://");
    if place.contains(':') { place.to_owned() } else { format!("127.0.0.1:{place}") }
}

fn evaluate(folder: &Path, name: &str, arguments: &[&str]) -> Vec<EpisodeRecord> {
    let folder = folder.join(name);
    std::fs::create_dir(&folder).expect("a folder");
    let tasks = format!("--tasks={TASK}");
    let arguments = [&[&*tasks, "--episodes=1", "--sessions=2"], arguments].concat();
    let evaluation = Evaluation::new(&folder, &arguments);
    evaluation.finish();
    let records: Vec<EpisodeRecord> = evaluation.records().into_values().collect();
    assert!(!records.is_empty());
    records
}

/// A decision without its times, and without what only records of a policy server hold.
fn comparable(decision: &DecisionRecord) -> DecisionRecord {
    let mut decision = DecisionRecord { batch_ms: 0.0, batch_size: 0, ..decision.clone() };
    decision.candidates.iter_mut().for_each(|candidate| candidate.reading = None);
    decision
}

/// Runs a command to its end and returns what it said.
fn said(command: &mut Command, code: i32) -> String {
    let output = run(command);
    let said = text(&output);
    assert_eq!(output.status.code(), Some(code), "{command:?}: {said}");
    said
}

#[test]
fn the_served_agent_decides_as_the_local_one_bit_by_bit() {
    let folder = tempfile::tempdir().expect("a folder");
    let verifier = repository().join("agent/models/bridge-small/verifier.safetensors");
    let verifier = format!("--verifier={}", verifier.display());
    let settings =
        ["--strategies=greedy,verifier", "--candidates=3", "--seed=5", "--all-hidden", &verifier];
    let local = evaluate(folder.path(), "local", &settings);
    let server = of_rever();
    for wire in ["openpi", "vla-eval"] {
        let policy = format!("--policy={wire}://{}", place(&server));
        let served = evaluate(folder.path(), wire, &[&settings[..], &[&policy]].concat());
        assert_eq!(served.len(), local.len());
        for (served, local) in served.iter().zip(&local) {
            assert_eq!(served.versions.policy, local.versions.policy, "the announced digest");
            assert_eq!(served.steps.len(), local.steps.len(), "{}", local.identity.id());
            for (step, (served, local)) in served.steps.iter().zip(&local.steps).enumerate() {
                let (served, local) = (served.decision.as_ref(), local.decision.as_ref());
                let decisions = (served.map(comparable), local.map(comparable));
                assert_eq!(decisions.0, decisions.1, "{wire}: step {step}");
                let candidates = served.iter().flat_map(|decision| &decision.candidates);
                let read = |one: &CandidateRecord| one.reading.is_some() == one.actions.is_some();
                assert!(candidates.clone().all(read), "{wire}: step {step}: what the server said");
            }
        }
    }
}

#[test]
fn a_chunk_is_the_same_whether_client_or_server_keeps_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let profile = folder.path().join("chunks.toml");
    let shipped = repository().join("agent/remote-policy/profiles/simpler.toml");
    let shipped = std::fs::read_to_string(shipped).expect("a profile");
    let chunks = shipped.replace("execute = 1", "execute = 3").replace("= 224", "= 64");
    std::fs::write(&profile, chunks).expect("a file");
    let profile = format!("--policy-profile={}", profile.display());
    let episodes = |wire: &str| {
        let server = of_peer(wire);
        let policy = format!("--policy={wire}://{}", place(&server));
        evaluate(folder.path(), wire, &["--strategies=sample", &policy, &profile]).remove(0)
    };
    let (openpi, vla_eval) = (episodes("openpi"), episodes("vla-eval"));
    assert_eq!(openpi.steps.len(), vla_eval.steps.len());
    for (step, (client, server)) in openpi.steps.iter().zip(&vla_eval.steps).enumerate() {
        assert_eq!(client.action, server.action, "step {step}");
        assert_eq!(
            client.decision.is_some(),
            step % CHUNK == 0,
            "the record says which steps were decided"
        );
        assert!(server.decision.is_some(), "one question per observation");
    }
    let first = openpi.steps[0].decision.as_ref().expect("a decision");
    let actions = first.candidates[0].actions.as_ref().expect("actions");
    assert_eq!(actions.actions().len(), CHUNK);
    // Candidates that a policy server draws are listed in the report of the run.
    let mut report = rever();
    report.arg("report").arg(folder.path().join("openpi/run"));
    let output = run(&mut report);
    assert!(output.status.success(), "{}", text(&output));
}

#[test]
fn candidates_of_a_server_in_python_do_not_depend_on_the_other_requests() {
    let folder = tempfile::tempdir().expect("a folder");
    let server = of_peer("drawn");
    let policy = format!("--policy=openpi://{}", place(&server));
    let episodes = |name: &str, strategies: &str| {
        evaluate(folder.path(), name, &["--candidates=3", "--seed=5", &policy, strategies])
    };
    let alone = episodes("alone", "--strategies=medoid").remove(0);
    let among = episodes("among", "--strategies=greedy,sample,medoid");
    let same = among.iter().find(|record| record.identity.id() == alone.identity.id());
    let same = same.expect("the same episode");
    assert_eq!(alone.steps.len(), same.steps.len());
    for (step, (alone, same)) in alone.steps.iter().zip(&same.steps).enumerate() {
        let (alone, same) = (alone.decision.as_ref(), same.decision.as_ref());
        assert_eq!(alone.map(comparable), same.map(comparable), "step {step}");
        assert_eq!(alone.is_some(), step % CHUNK == 0, "step {step}");
        let Some(decision) = alone else { continue };
        assert_eq!(decision.candidates.len(), 3);
        assert_ne!(decision.candidates[0].actions, decision.candidates[1].actions);
    }
}

#[test]
fn a_verifier_is_trained_on_what_a_backbone_reads_of_a_policy_server() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = |name: &str| folder.path().join(name);
    let server = of_rever();
    let policy = format!("--policy=openpi://{}", place(&server));
    let python = format!("--python={}", python().python.display());
    let on_server = |command: &str, run: &str, more: &[&str]| {
        let mut program = rever();
        program.args([command, &policy, &python, "--sessions=2"]).args(more);
        program.arg("--out").arg(file(run)).arg("--labels").arg(file("labels.sqlite"));
        program
    };
    let read = ["--backbone=included", "--candidates=3"];
    said(&mut on_server("collect", "labels", &[&read[..], &["--episodes=6"]].concat()), 0);
    let ids = store::run::recorded(&file("labels")).expect("records");
    assert_eq!(ids.len(), 24);
    for id in &ids {
        let path = store::run::record_path(&file("labels"), id);
        let record = EpisodeRecord::read(&path).expect("a record");
        for candidate in record.decisions().flat_map(|decision| &decision.candidates) {
            let Some(reading) = &candidate.reading else { continue };
            assert_eq!(candidate.hidden.as_ref().map(Vec::len), Some(2 * 256), "{id}");
            assert_eq!((reading.confidence.len(), reading.reasoning.task.is_empty()), (16, false));
        }
    }
    let verifier = file("verifier.safetensors");
    let mut train = rever();
    train.arg("train").arg(file("labels")).arg("--epochs=2").arg("--out").arg(&verifier);
    let trained = said(&mut train, 0);
    let next = "next: rever evaluate --policy openpi://HOST:PORT --policy-profile rever --backbone included";
    assert!(trained.contains(next), "{trained}");
    let named = format!("--verifier={}", verifier.display());
    let one = ["--tasks=stack_cube", "--strategies=verifier", "--episodes=1", &named];
    // The second time there is nothing left to do: a run with a policy server is resumed.
    for _ in 0..2 {
        said(&mut on_server("evaluate", "run", &[&read[..], &one].concat()), 0);
    }
    let scores = said(rever().arg("report").arg(file("run")).arg(&named), 0);
    assert!(scores.contains("1 with steps"), "{scores}");
    let step = std::fs::read_dir(file("run/report/data")).expect("a report").flatten();
    let step = step.map(|entry| std::fs::read_to_string(entry.path()).expect("a script"));
    assert!(!step.collect::<String>().contains("terms of the scores are not shown"));
    // Without the backbone the candidates are another policy's.
    let other = said(&mut on_server("evaluate", "other", &one), 2);
    assert!(other.contains("policy"), "{other}");
    assert!(!file("other").exists(), "nothing was started");
}

#[test]
fn episodes_without_hidden_states_train_no_verifier() {
    let folder = tempfile::tempdir().expect("a folder");
    let server = of_peer("openpi");
    let policy = format!("--policy=openpi://{}", place(&server));
    let out = folder.path().join("labels");
    let mut collect = rever();
    collect.args(["collect", &policy, "--episodes=1", "--tasks=stack_cube"]);
    collect.arg(format!("--python={}", python().python.display())).arg("--out").arg(&out);
    said(collect.arg("--labels").arg(folder.path().join("labels.sqlite")), 0);
    let refused = said(rever().arg("train").arg(&out), 2);
    assert!(refused.contains("--backbone included"), "{refused}");
}

#[test]
fn what_a_policy_server_cannot_do_is_refused_before_anything_starts() {
    let server = of_peer("openpi");
    let policy = format!("--policy=openpi://{}", place(&server));
    let nobody = "--policy=vla-eval://127.0.0.1:1".to_owned();
    for (arguments, expected) in [
        (
            vec!["evaluate", &policy, "--strategies=verifier"],
            "expected a policy that exposes hidden states",
        ),
        (vec!["evaluate", &policy, "--strategies=greedy"], "answers = \"greedy\""),
        (
            vec!["evaluate", &policy, "--temperature=0.5", "--strategies=sample"],
            "takes no temperature",
        ),
        (vec!["evaluate", &policy, "--policy-profile=brigde"], "did you mean bridge?"),
        (
            vec!["collect", &policy, "--unnorm-key=a"],
            "--unnorm-key a: expected a checkpoint's folder",
        ),
        (vec!["train", &policy], "expected a checkpoint's folder, got the policy server"),
        (vec!["evaluate", "--backbone=included"], "--backbone: expected a policy server"),
        (vec!["evaluate", &policy, "--backbone=no/where"], "--backbone: expected a checkpoint's"),
        (vec!["evaluate", "--policy-profile=bridge"], "--policy-profile: expected a policy server"),
        (vec!["evaluate", &nobody], "policy server vla-eval://127.0.0.1:1: cannot connect"),
        (vec!["evaluate", "--policy=ws://127.0.0.1:1"], "which of the two does the server speak?"),
    ] {
        let output = run(rever().args(&arguments));
        let said = text(&output);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {said}");
        assert!(said.contains(expected), "{arguments:?}: {said}");
    }
}
