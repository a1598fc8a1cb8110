//! The command line as its user meets it: wrong usage, help, lists, narrow terminals, Ctrl-C.

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::harness::{python, rever, run, succeed, text, wait_for};
use crate::server::free_endpoint;

/// Longest wait for what takes a moment on a machine with nothing else to do.
const WAIT: Duration = Duration::from_secs(120);

/// Runs `rever` in a folder.
fn in_folder(folder: &Path, words: &[&str]) -> Output {
    run(rever().current_dir(folder).args(words))
}

#[test]
fn wrong_usage_is_refused_before_anything_starts() {
    let folder = tempfile::tempdir().expect("a folder");
    let cases: [(&[&str], &[&str]); 12] = [
        (&["evaluat"], &["evaluat", "evaluate"]),
        (&["evaluate", "--strategies", "verifer"], &["a similar value exists: 'verifier'"]),
        (&["evaluate", "--episodes", "0"], &["invalid value '0'"]),
        (&["evaluate", "--episodes", "-3"], &["invalid value '-3'"]),
        (&["evaluate", "--connect", "10.0.0.7"], &["expected HOST:PORT", "10.0.0.7"]),
        (&["evaluate", "--policy", "openvla/openvla-7b"], &["checkpoint's folder", "hf download"]),
        (&["evaluate", "--verifier", "none.safetensors"], &["verifier none.safetensors"]),
        (&["evaluate", "--device", "cuda"], &["--features cuda"]),
        (&["evaluate", "--fleet", "a b"], &["--fleet"]),
        (&["train", "--epochs", "0"], &["epochs: expected"]),
        (&["conformance"], &["--server", "--connect"]),
        (&["show", "nothing"], &["expected a run's folder", "rever list runs"]),
    ];
    for (words, expected) in cases {
        let output = in_folder(folder.path(), words);
        let said = text(&output);
        assert_eq!(output.status.code(), Some(2), "{words:?}: {said}");
        assert!(expected.iter().all(|part| said.contains(part)), "{words:?}: {said}");
    }
    let left = std::fs::read_dir(folder.path()).expect("a folder").count();
    assert_eq!(left, 0, "wrong usage leaves nothing behind");
}

#[test]
fn a_misspelt_task_is_refused_with_a_suggestion() {
    let folder = tempfile::tempdir().expect("a folder");
    let python = python().python.to_string_lossy().into_owned();
    let words = ["evaluate", "--tasks=stak", "--out=run", "--python", &python];
    let output = in_folder(folder.path(), &words);
    let said = text(&output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("did you mean widowx_stack_cube?"), "{said}");
    assert!(!folder.path().join("run").exists(), "no run is left behind");
}

#[test]
fn an_address_at_which_nothing_listens_is_told_within_seconds() {
    let folder = tempfile::tempdir().expect("a folder");
    let endpoint = free_endpoint();
    let address = endpoint.trim_start_matches("tcp/");
    let mut evaluate = rever();
    evaluate.current_dir(folder.path()).args(["evaluate", "--connect", address]);
    let begun = Instant::now();
    let output = run(&mut evaluate);
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains(&format!("cannot connect to {address}: ")), "{said}");
    assert!(said.contains("expected an environment server or a zenoh router"), "{said}");
    // zenoh alone would try for 30 s.
    assert!(begun.elapsed() < Duration::from_secs(25), "{:?}", begun.elapsed());
}

#[test]
fn every_command_has_help_that_fits_a_terminal() {
    let commands: [&[&str]; 18] = [
        &[],
        &["demo"],
        &["evaluate"],
        &["collect"],
        &["train"],
        &["report"],
        &["show"],
        &["list"],
        &["list", "tasks"],
        &["list", "runs"],
        &["doctor"],
        &["bench"],
        &["bench", "decision"],
        &["bench", "throughput"],
        &["conformance"],
        &["digest"],
        &["completions"],
        &["man"],
    ];
    for command in commands {
        let help = succeed(rever().args(command).arg("--help"));
        for line in help.lines() {
            assert!(line.chars().count() <= 120, "{command:?}: {line}");
        }
        assert!(!help.contains('\x1b'), "{command:?}: colours in a pipe");
    }
    let version = succeed(rever().arg("--version"));
    assert!(version.starts_with("rever 0.0.0 (") && version.contains(", 20"), "{version}");
}

#[test]
fn what_there_is_can_be_listed_and_shown() {
    let folder = tempfile::tempdir().expect("a folder");
    let python = python().python.to_string_lossy().into_owned();
    let tasks = succeed(rever().args(["list", "tasks", "--python", &python]));
    for name in ["stack", "widowx_stack_cube", "put carrot on plate"] {
        assert!(tasks.contains(name), "{name}: {tasks}");
    }
    assert!(!tasks.contains("distractors"), "a variant: {tasks}");
    let variants = succeed(rever().args(["list", "variants", "--python", &python]));
    assert!(variants.contains("spoon/distractors"), "{variants}");
    let strategies = succeed(rever().args(["list", "strategies"]));
    assert_eq!(strategies.lines().count(), 1 + 9 + 1, "{strategies}");

    let words = ["--tasks=stack", "--strategies=sample", "--episodes=1", "--out=runs/one"];
    let evaluate = || {
        let mut command = rever();
        command.current_dir(folder.path()).arg("evaluate").args(words).args(["--python", &python]);
        command
    };
    let said = succeed(&mut evaluate());
    assert!(said.ends_with("next: rever report runs/one\n"), "{said}");
    let again = run(&mut evaluate());
    assert!(
        text(&again).contains("all 1 episodes are recorded, nothing to run"),
        "{}",
        text(&again)
    );
    let quiet = run(evaluate().arg("-q"));
    assert!(quiet.stderr.is_empty(), "{}", text(&quiet));
    let listed = succeed(rever().current_dir(folder.path()).args(["list", "runs"]));
    assert!(listed.contains("runs/one") && listed.contains("1 of 1"), "{listed}");
    let show = |words: &[&str]| succeed(rever().current_dir(folder.path()).arg("show").args(words));
    let short = show(&["runs/one"]);
    assert!(
        short
            .lines()
            .filter(|line| !line.contains("evaluate"))
            .all(|line| line.chars().count() <= 80),
        "{short}"
    );
    assert!(!short.contains("Milliseconds"), "{short}");
    assert!(show(&["runs/one", "-v"]).contains("Milliseconds"), "all tables");
}

#[test]
fn shells_and_man_get_what_they_need() {
    let folder = tempfile::tempdir().expect("a folder");
    for shell in ["bash", "zsh", "fish"] {
        let script = succeed(rever().args(["completions", shell]));
        assert!(script.contains("evaluate"), "{shell}");
    }
    succeed(rever().arg("man").arg(folder.path()));
    let page = std::fs::read_to_string(folder.path().join("rever-evaluate.1")).expect("a page");
    assert!(page.contains("strategies"), "{page}");
}

#[test]
fn ctrl_c_ends_a_run_at_any_stage_and_the_same_command_resumes_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let evaluate = || -> Command {
        // A test that runs in the background of a script inherits that Ctrl-C is ignored.
        let mut command = Command::new("env");
        command.arg("--default-signal=INT").arg(rever().get_program());
        command.current_dir(folder.path()).arg("evaluate").args([
            "--tasks=stack",
            "--strategies=sample",
            "--layouts=random",
            "--episodes=4",
            "--sessions=1",
            "--out=run",
            "--labels=labels.sqlite",
        ]);
        command.arg("--python").arg(&python().python);
        command
    };
    let interrupted = |is_time: &dyn Fn(u32) -> bool| {
        let mut child =
            evaluate().stderr(Stdio::null()).stdout(Stdio::null()).spawn().expect("it starts");
        wait_for("the moment", WAIT, || is_time(child.id()).then_some(()));
        let id = Pid::from_child(&child);
        kill_process(id, Signal::INT).expect("it runs");
        wait_for("its end", WAIT, || child.try_wait().expect("a child can be asked"))
    };
    // `env` has become `rever`.
    let is_rever = |process| {
        let name = std::fs::read_to_string(format!("/proc/{process}/comm"));
        name.is_ok_and(|name| name.trim() == "rever")
    };
    let early = interrupted(&is_rever);
    assert!(!early.success(), "{early}");
    let records =
        || std::fs::read_dir(folder.path().join("run/episodes")).map_or(0, Iterator::count);
    let later = interrupted(&|_| records() > 0);
    assert_eq!(later.code(), Some(130), "{later}");
    assert!((1..4).contains(&records()), "{} records", records());
    let output = run(&mut evaluate());
    let said = text(&output);
    assert!(output.status.success() && said.contains("resuming, "), "{said}");
    assert_eq!(records(), 4);
}
