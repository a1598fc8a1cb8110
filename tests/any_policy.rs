//! Policies other than the included one: without a verifier, with another image size, read in a wrong
//! way.

use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use serde_json::Value;
use tempfile::TempDir;

use crate::harness::{python, repository, rever, run, succeed, text};

/// Episodes on few servers, in a folder of their own.
const SMALL: [&str; 4] = ["--episodes=1", "--tasks=spoon", "--out=run", "--labels=labels.sqlite"];

/// A folder with a link to random weights for images of 32 x 32 pixels, without a verifier.
fn random_policy() -> TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    let tiny = repository().join("agent/vla/tests/fixtures/tiny");
    symlink(tiny, folder.path().join("tiny")).expect("a link");
    folder
}

/// The included policy in a folder of its own, without its verifier.
fn included_without_verifier(folder: &Path) -> PathBuf {
    let (from, to) = (repository().join("agent/models/bridge-small"), folder.join("mine"));
    std::fs::create_dir(&to).expect("a folder");
    for name in ["config.json", "model.safetensors", "tokenizer.json"] {
        symlink(from.join(name), to.join(name)).expect("a link");
    }
    to
}

#[test]
fn a_policy_that_is_never_well_formed_ends_the_run_with_the_reason() {
    let folder = random_policy();
    for command in [&["evaluate", "--strategies=sample"][..], &["collect", "--candidates=2"]] {
        let mut program = rever();
        program.current_dir(folder.path()).args(command).args(SMALL).args(["--policy=tiny"]);
        let output = run(program.arg("--python").arg(&python().python));
        let said = text(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        for words in [
            "in the first 20 decisions, got none",
            "first candidate: expected",
            "its text: \"",
            "--reasoning",
        ] {
            assert!(said.contains(words), "{words}: {said}");
        }
        assert!(!said.contains("rerun the same command"), "it would end in the same way: {said}");
        let run = folder.path().join("run");
        let records = run.join("episodes").read_dir().map_or(0, Iterator::count);
        assert_eq!(records, 0, "a fault has no record: {said}");
        let faults = store::run::faults(&run).expect("the faults of the run");
        assert!(
            faults.iter().any(|fault| fault.reason.contains("first 20 decisions")),
            "{faults:?}"
        );
        std::fs::remove_dir_all(run).expect("the run can be removed");
    }
    let labels = store::labels::labels(&folder.path().join("labels.sqlite")).expect("a store");
    assert!(labels.is_empty(), "a fault has no label");
}

#[test]
fn doctor_says_what_a_policy_writes_instead_of_an_action() {
    let folder = random_policy();
    let mut doctor = rever();
    doctor.current_dir(folder.path()).args(["doctor", "--policy=tiny", "--python"]);
    let output = run(doctor.arg(&python().python));
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for words in ["none of 5 candidates is well formed", "its text: \"", "not ready: decision"] {
        assert!(said.contains(words), "{words}: {said}");
    }
}

#[test]
fn a_strategy_that_needs_a_verifier_is_refused_before_the_weights_are_read() {
    let folder = random_policy();
    // A folder without any weights.
    let empty = folder.path().join("empty");
    std::fs::create_dir(&empty).expect("a folder");
    let mut evaluate = rever();
    evaluate.current_dir(folder.path()).args(["evaluate", "--policy=empty"]);
    let output = run(evaluate.args(["--strategies=sample,verifier"]).args(SMALL));
    let said = text(&output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("strategy verifier: expected a verifier (--verifier FILE)"), "{said}");
}

#[test]
fn decisions_and_episodes_of_any_policy_are_timed() {
    let folder = random_policy();
    let policy = included_without_verifier(folder.path());
    let figures = |words: &[&str]| -> Value {
        let file = folder.path().join("bench.json");
        let mut bench = rever();
        bench.current_dir(folder.path()).arg("bench").args(words).arg("--json").arg(&file);
        succeed(&mut bench);
        let text = std::fs::read(file).expect("the figures");
        serde_json::from_slice(&text).expect("JSON")
    };
    // Images of 32 x 32 pixels, although the recorded ones have 128 x 128.
    let decision = figures(&["decision", "--rounds=1", "--policy=tiny"]);
    assert_eq!((&decision["strategy"], &decision["verifier"]), (&"medoid".into(), &Value::Null));
    assert_eq!(decision["rows"].as_array().map(Vec::len), Some(6));
    let policy = format!("--policy={}", policy.display());
    let python = format!("--python={}", python().python.display());
    let throughput = figures(&["throughput", "--sessions=2", "--decisions=40", &policy, &python]);
    assert!(throughput["rows"][0]["decisions"].as_u64() >= Some(40), "{throughput}");
}

#[test]
fn a_policy_without_a_verifier_is_demonstrated_and_reported() {
    let folder = random_policy();
    included_without_verifier(folder.path());
    let mut demo = rever();
    demo.current_dir(folder.path()).args(["demo", "--policy=mine", "--max-new-tokens=64"]);
    demo.args(["--episodes=1", "--out=run", "--python"]).arg(&python().python);
    let said = succeed(&mut demo);
    assert!(said.contains("with the medoid, because the policy has no verifier"), "{said}");
    assert!(said.contains("rever evaluate --policy mine --max-new-tokens 64"), "{said}");
    assert!(folder.path().join("run/report/index.html").is_file());
    let header = store::run::read_header(&folder.path().join("run")).expect("a header");
    assert_eq!(header.options["policy_options"], serde_json::json!({"max_new_tokens": 64}));
    // The page needs the tokenizer alone, and takes the options from the run.
    std::fs::remove_file(folder.path().join("mine/model.safetensors")).expect("a link");
    let report = ["report", "run", "--policy=mine", "--out=again"];
    succeed(rever().current_dir(folder.path()).args(report));
    let output = run(rever().current_dir(folder.path()).args(["report", "run", "--policy=tiny"]));
    let said = text(&output);
    assert!(said.contains("this policy reads its candidates in another way"), "{said}");
}
