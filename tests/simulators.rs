//! The native simulator compared with the Python one (bitwise equal numbers), and conformance
//! tests.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::net::{Ipv4Addr, TcpListener};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use runtime::servers::{Missing, ServerProgram, Simulator, simulators_environment};
use serde_json::Value;

use crate::harness::{installation, python, repository, rever, run, simulator, succeed, text};
use crate::server::free_endpoint;

/// The rules that a server with these defects must violate, and no others.
const BROKEN: [(&str, &[&str]); 8] = [
    ("answers_older,never_ends,other_size", &["older", "horizon", "observation"]),
    ("repeats_twice", &["repeated", "close"]),
    (
        "drifts,mute,any_version",
        &[
            "heartbeat",
            "version",
            "repeated",
            "gap",
            "unreadable",
            "size",
            "number_limit",
            "values",
            "dimensions",
            "slots",
            "deterministic",
            "concurrent",
        ],
    ),
    ("jumps_gaps,forgets_command,steps_unreset", &["gap", "save", "reset_first"]),
    (
        "one_seed,no_limit,overstates_time,forgets_tile",
        &["seeds", "sessions_max", "simulator_time", "save"],
    ),
    ("forgets_close,any_length,changes_world_first", &["sessions_max", "dimensions", "reset_task"]),
    ("any_variant", &["reset_task", "tasks"]),
    ("keeps_leases", &["holder_gone", "holder_missing"]),
];

/// Built once.
fn native() -> &'static ServerProgram {
    static PROGRAM: OnceLock<ServerProgram> = OnceLock::new();
    PROGRAM.get_or_init(|| simulator(Simulator::Native))
}

fn trace(program: &ServerProgram, arguments: &[&str]) -> Vec<Value> {
    let said = succeed(program.command().args(["trace", "--tasks", "all"]).args(arguments));
    said.lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect()
}

/// Compares joint positions, velocities, state, the expert's action, statistics and the image of
/// every step of every task in every variant. Returns the number of lines.
fn assert_equal_traces(arguments: &[&str]) -> usize {
    let in_python = ServerProgram::Python(python().clone());
    let (expected, got) = (trace(&in_python, arguments), trace(native(), arguments));
    assert_eq!(expected.len(), got.len(), "{arguments:?}");
    for (expected, got) in expected.iter().zip(&got) {
        assert_eq!(expected, got, "{arguments:?}");
    }
    expected.len()
}

#[test]
fn the_experts_episodes_are_equal_bit_for_bit() {
    let lines = assert_equal_traces(&["--seeds", "5"]);
    assert!(lines > 7 * 60, "expected a reset and an episode's steps of each, got {lines} lines");
}

#[test]
fn wild_actions_are_equal_bit_for_bit() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = wild_actions(folder.path(), 120);
    let actions = ["--layouts", "7", "--side", "224", "--actions", &file];
    let lines = assert_equal_traces(&actions);
    assert!(lines > 7 * 60, "expected a reset and an episode's steps of each, got {lines} lines");
}

#[test]
fn every_layout_and_random_ones_are_equal_bit_for_bit() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = wild_actions(folder.path(), 3);
    let layouts: Vec<String> = (0..24).map(|layout| layout.to_string()).collect();
    let seeds: Vec<String> = (0..24).map(|seed: u64| (seed << 48 | seed).to_string()).collect();
    for (name, starts) in [("--layouts", layouts), ("--seeds", seeds)] {
        let mut arguments = vec!["--side", "16", "--actions", &file, name];
        arguments.extend(starts.iter().map(String::as_str));
        assert!(assert_equal_traces(&arguments) >= 7 * 24 * 4);
    }
}

/// Shapes outside the image are not rendered. A wrong test at the image's edges would change
/// pixels.
#[test]
fn images_of_an_arm_that_crosses_their_edges_are_equal_bit_for_bit() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("actions.txt");
    let to_the_left = "0 0.04 0 0 0 0 1\n".repeat(15);
    let to_the_right = "0 -0.04 0 0 0 0 1\n".repeat(30);
    let and_turned = "0.02 0.04 -0.01 0.2 0 0 -1\n".repeat(15);
    std::fs::write(&file, to_the_left + &to_the_right + &and_turned).expect("written");
    let file = file.to_str().expect("a readable path");
    let lines = assert_equal_traces(&["--layouts", "3", "--actions", file]);
    assert!(lines > 7 * 60, "expected a reset and an episode's steps of each, got {lines} lines");
}

/// A file of actions that differ strongly from the expert's.
fn wild_actions(folder: &Path, count: usize) -> String {
    let file = folder.join("actions.txt");
    let mut actions = String::new();
    let mut state = 1u32;
    let mut uniform = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state) / f64::from(u32::MAX) - 0.5
    };
    for _ in 0..count {
        for scale in [0.06, 0.06, 0.06, 0.3, 0.3, 0.6, 2.0] {
            write!(actions, "{} ", scale * uniform()).expect("a text takes more");
        }
        actions.push('\n');
    }
    std::fs::write(&file, actions).expect("written");
    file.to_str().expect("a readable path").to_owned()
}

/// A replacement in tasks.toml, and the text of both programs' errors.
const WRONG_TASKS: [(&str, &str, &str); 5] = [
    ("[tasks.widowx_spoon_on_towel.variants.paraphrase]", "hight = 1", "hight"),
    ("[tasks.widowx_spoon_on_towel.variants.paraphrase]", "random.speed = 1", "speed"),
    ("[tasks.widowx_spoon_on_towel.variants.paraphrase]", "mjcf.geom.a.size = 1", "size"),
    ("separation_min = 0.13\nlayouts = [", "  [0.0, 0.0, 0.0],", "24"),
    ("[world]", "gravity = 9.81", "gravity"),
];

#[test]
fn both_programs_name_the_invalid_key_of_tasks_toml() {
    let ServerProgram::Native { program, assets, .. } = native() else {
        unreachable!("it is native")
    };
    let whole = std::fs::read_to_string(assets.join("tasks.toml")).expect("it can be read");
    let folder = tempfile::tempdir().expect("a folder");
    for (after, added, named) in WRONG_TASKS {
        let changed = whole.replacen(after, &format!("{after}\n{added}"), 1);
        assert_ne!(changed, whole);
        std::fs::write(folder.path().join("tasks.toml"), changed).expect("written");
        let mut natively = Command::new(program);
        natively.arg("--assets").arg(folder.path()).args(["trace", "--tasks", "all"]);
        let mut in_python = python().command();
        let load = "import sys, pathlib, rever_env.tasks as t; t.load(pathlib.Path(sys.argv[1]))";
        in_python.args(["-c", load]).arg(folder.path());
        for command in [&mut natively, &mut in_python] {
            let output = run(command);
            let said = text(&output);
            assert!(!output.status.success(), "{added}: {said}");
            assert!(said.contains("tasks.toml") && said.contains(named), "{added}: {said}");
        }
    }
}

/// The violated rules, the number of passed rules, and the output.
fn conformance(arguments: &[&str]) -> (BTreeSet<String>, usize, String) {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("rows.json");
    let mut command = rever();
    command.current_dir(repository()).arg("conformance").args(arguments).arg("--json").arg(&file);
    let output = run(&mut command);
    let rows = std::fs::read(&file).unwrap_or_else(|error| panic!("{error}\n{}", text(&output)));
    let rows: Vec<Value> = serde_json::from_slice(&rows).expect("rows");
    let with = |verdict: &str| -> BTreeSet<String> {
        let rows = rows.iter().filter(|row| row["verdict"] == verdict);
        rows.map(|row| row["name"].as_str().expect("a name").to_owned()).collect()
    };
    let failed = with("fail");
    assert_eq!(output.status.success(), failed.is_empty(), "{}", text(&output));
    (failed, with("pass").len(), text(&output))
}

#[test]
fn our_servers_conform() {
    for server in ["python", "native", "robosuite"] {
        let (failed, passed, said) = conformance(&["--server", server]);
        assert!(failed.is_empty(), "{server}: {said}");
        assert_eq!(passed, said.lines().filter(|line| line.starts_with("pass ")).count());
        // No dimension of a Bridge action is discrete.
        let skipped: Vec<&str> = said.lines().filter(|line| line.starts_with("skip ")).collect();
        assert!(matches!(skipped[..], [only] if only.contains(" discrete ")), "{server}: {said}");
    }
}

#[test]
fn a_gymnasium_environment_conforms() {
    let python = simulators_environment(&installation(), Missing::Install)
        .expect("the simulators are set up");
    let mut command = python.command();
    command.args(["-m", "rever_env", "serve", "--gymnasium", "CartPole-v1"]);
    let (failed, passed, said) = conformance_of(&mut command);
    assert!(failed.is_empty(), "{said}");
    // Its action is discrete, so no rule is skipped.
    assert!(said.contains(&format!("{passed} passed, 0 failed, 0 not tested")), "{said}");
}

#[test]
fn a_task_with_another_action_length_is_refused_with_a_reason() {
    let mut command = python().command();
    command.args(["-m", "rever_env", "serve", "--gymnasium", "CartPole-v1"]);
    serving(&mut command, |endpoint| {
        let folder = tempfile::tempdir().expect("a folder");
        let mut evaluate = rever();
        evaluate.current_dir(folder.path());
        evaluate.args(["evaluate", "--connect", endpoint, "--tasks", "CartPole-v1"]);
        evaluate.args(["--strategies", "greedy", "--episodes", "1"]);
        let mut on_the_grid = rever();
        on_the_grid.args(evaluate.get_args()).current_dir(folder.path());
        let output = run(&mut on_the_grid);
        let said = text(&output);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains("layouts: expected random ones for CartPole-v1"), "{said}");
        let output = run(evaluate.args(["--layouts", "random"]));
        let said = text(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        let words = "expected actions with 7 dimensions, as in the policy, got 1";
        assert!(said.contains("task CartPole-v1") && said.contains(words), "{said}");
    });
}

#[test]
fn a_faulty_client_does_not_affect_others_of_the_native_server() {
    let mut pytest = python().command();
    pytest
        .current_dir(repository().join("env-server"))
        .env("REVER_SIMULATOR", native().command().get_program())
        .args(["-m", "pytest", "--quiet", "-k", "native", "tests/test_hostile_clients.py"]);
    let said = succeed(&mut pytest);
    assert!(said.contains("6 passed"), "{said}");
}

#[test]
fn the_native_server_reports_wrong_usage_in_one_line() {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).expect("there is a free port");
    let taken = listener.local_addr().expect("a bound listener has an address").to_string();
    let taken = format!("tcp/{taken}");
    let free = free_endpoint();
    for (arguments, status, words) in [
        (&[][..], 2, "--connect <ENDPOINT>|--listen <ENDPOINT>|--multicast"),
        (&["--listen", &free, "--fleet", "../x"], 2, "invalid fleet name"),
        (&["--listen", &free, "--sessions", "0"], 2, "0 is not in 1..=256"),
        (&["--listen", &free, "--id-file", "/nowhere/id"], 1, "its folder does not exist"),
        (&["--listen", &taken], 1, "Address already in use"),
    ] {
        let output = run(native().command().arg("serve").args(arguments));
        let said = text(&output);
        assert_eq!(output.status.code(), Some(status), "{arguments:?}: {said}");
        assert!(said.contains(words) && !said.contains(".rs"), "{arguments:?}: {said}");
    }
}

/// The conformance results of a server that is started with this command.
fn conformance_of(command: &mut Command) -> (BTreeSet<String>, usize, String) {
    serving(command, |endpoint| conformance(&["--connect", endpoint]))
}

/// Runs `act` while a server runs that is started with this command.
fn serving<T>(command: &mut Command, act: impl FnOnce(&str) -> T) -> T {
    let endpoint = free_endpoint();
    let mut server = command
        .args(["--sessions", "4"])
        .args(["--exit-with-parent", "--listen", &endpoint])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the server starts");
    let result = act(&endpoint);
    server.kill().expect("the server runs");
    server.wait().expect("a killed server ends");
    result
}

#[test]
fn a_broken_server_violates_exactly_the_expected_rules() {
    // These tests mostly wait, so they run in parallel.
    for some in BROKEN.chunks(BROKEN.len() / 2) {
        std::thread::scope(|scope| {
            for (defects, rows) in some {
                scope.spawn(|| assert_failures(defects, rows));
            }
        });
    }
}

fn assert_failures(defects: &str, rows: &[&str]) {
    let mut command = python().command();
    command.arg(repository().join("tests/broken_server.py")).args([defects, "serve"]);
    let (failed, _, said) = conformance_of(&mut command);
    let expected: BTreeSet<String> = rows.iter().copied().map(str::to_owned).collect();
    assert_eq!(failed, expected, "{defects}: {said}");
}
