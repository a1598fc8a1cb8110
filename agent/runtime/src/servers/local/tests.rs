//! Shell scripts in place of servers test how the supervisor handles each kind of failure.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

use super::super::python::PythonEnvironment;
use super::*;

const WAIT_SECS: u64 = 20;
const FOR_EVER: Duration = Duration::from_secs(3600);

/// A server that is a shell script; `$FOLDER` is its own folder.
struct Script {
    folder: TempDir,
    count: usize,
    silence_max: Duration,
}

impl Script {
    fn new(script: &str) -> Script {
        let folder = tempfile::tempdir().unwrap();
        let python = folder.path().join("python");
        std::fs::write(&python, format!("#!/bin/sh\n{script}\n")).unwrap();
        std::fs::set_permissions(&python, std::fs::Permissions::from_mode(0o755)).unwrap();
        Script { folder, count: 1, silence_max: FOR_EVER }
    }

    fn start(&self, last_beat: fn(&str) -> Option<Instant>) -> Result<LocalServers> {
        let folder = self.folder.path();
        let variables = [("FOLDER", folder.as_os_str()), ("PATH", "/usr/bin:/bin".as_ref())];
        let program = ServerProgram::Python(PythonEnvironment {
            python: folder.join("python"),
            package_root: folder.to_owned(),
            variables: BTreeMap::from(
                variables.map(|(name, value)| (OsString::from(name), value.to_owned())),
            ),
        });
        let options = LocalServerOptions {
            count: self.count,
            connect: "tcp/127.0.0.1:1".to_owned(),
            fleet: "test".to_owned(),
            sessions_each: 1,
            silence_max: self.silence_max,
        };
        LocalServers::start(program, &options, last_beat)
    }
}

fn beats(_: &str) -> Option<Instant> {
    Some(Instant::now())
}

fn wait_until(what: &str, condition: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(WAIT_SECS);
    while !condition() {
        assert!(Instant::now() < deadline, "waited {WAIT_SECS} s until {what}");
        std::thread::yield_now();
    }
}

fn is_alive(process_id: u32) -> bool {
    Path::new(&format!("/proc/{process_id}")).exists()
}

fn error_of(script: &str) -> String {
    Script::new(script).start(beats).unwrap_err().to_string()
}

#[test]
fn all_servers_are_ready_and_end_when_the_value_is_dropped() {
    let mut script = Script::new("echo noise; echo ready $$; exec sleep 1000");
    script.count = 2;
    let servers = script.start(beats).unwrap();
    let processes = servers.process_ids();
    let names: Vec<String> = processes.iter().map(u32::to_string).collect();
    assert_eq!(servers.server_ids(), names);
    drop(servers);
    assert!(!processes.into_iter().any(is_alive));
}

#[test]
fn a_server_that_never_starts_is_an_error_with_its_last_output() {
    assert_eq!(
        error_of("echo no display >&2; exit 3"),
        "no environment server could be started: a server ended 3 times; last reason: exit status: 3\nno display"
    );
}

#[test]
fn the_last_output_has_no_control_characters_and_need_not_be_unicode() {
    let error = error_of(r"printf 'a\033[31mred\377\nb\n' >&2; exit 3");
    assert!(error.ends_with("\na[31mred\u{fffd}\nb"), "{error:?}");
}

#[test]
fn running_out_of_memory_is_reported() {
    let error = error_of("echo 'terminate called: std::bad_alloc' >&2; exit 134");
    assert!(error.contains("exit status: 134 (out of memory)\n"), "{error}");
    let error = error_of("kill -9 $$");
    assert!(
        error.contains(
            "SIGKILL) (killed by another process, possibly by the kernel for lack of memory"
        ),
        "{error}"
    );
}

#[test]
fn a_server_that_ends_while_starting_is_restarted() {
    let script = "if mkdir $FOLDER/once; then exit 1; fi; echo ready $$; exec sleep 1000";
    let servers = Script::new(script).start(beats).unwrap();
    assert_eq!((servers.server_ids().len(), servers.restarts(), servers.given_up()), (1, 1, None));
}

#[test]
fn a_server_that_cannot_start_does_not_stop_the_others() {
    let mut script = Script::new(
        "if mkdir $FOLDER/once; then echo ready $$; exec sleep 1000; fi; echo broken >&2; exit 1",
    );
    script.count = 2;
    let servers = script.start(beats).unwrap();
    assert_eq!((servers.server_ids().len(), servers.given_up()), (1, None));
}

#[test]
fn a_server_that_ends_or_is_replaced_is_restarted() {
    let script = Script::new("echo ready $$; exec sleep 1000");
    let servers = script.start(beats).unwrap();
    let first = servers.server_ids();
    servers.replace("of another machine");
    servers.replace(&first[0]);
    wait_until("the server is back", || {
        let now = servers.server_ids();
        now.len() == 1 && now != first
    });
    assert_eq!((servers.restarts(), servers.given_up()), (1, None));
}

#[test]
fn a_frozen_server_is_replaced_when_its_heartbeats_stop() {
    let mut script = Script::new("echo ready $$; exec sleep 1000");
    script.silence_max = Duration::from_secs(1);
    let servers = script.start(|_| None).unwrap();
    let frozen = servers.process_ids()[0];
    kill_process(Pid::from_raw(frozen as i32).unwrap(), Signal::STOP).unwrap();
    wait_until("the frozen one is gone", || !is_alive(frozen));
    wait_until("another one runs", || servers.restarts() > 0 && servers.server_ids().len() == 1);
    assert_ne!(servers.process_ids(), [frozen]);
}

#[test]
fn the_processes_of_a_server_end_with_it() {
    let script = Script::new("sleep 1000 & echo $! > $FOLDER/child; echo ready $$; wait");
    let servers = script.start(beats).unwrap();
    let child = std::fs::read_to_string(script.folder.path().join("child")).unwrap();
    let child = child.trim().parse().unwrap();
    assert!(is_alive(child));
    drop(servers);
    // The operating system removes a process without a waiting parent at some later time.
    wait_until("the child is gone", || !is_alive(child));
}

#[test]
fn the_end_of_a_server_is_detected_even_if_another_process_holds_its_pipes() {
    let script =
        "mkdir $FOLDER/once && { setsid sleep 30 & exit 1; }; echo ready $$; exec sleep 1000";
    let servers = Script::new(script).start(beats).unwrap();
    assert_eq!((servers.server_ids().len(), servers.restarts()), (1, 1));
}

#[test]
fn a_server_that_keeps_ending_is_given_up() {
    let script = Script::new("echo ready $$; echo broken >&2");
    let servers = script.start(beats).unwrap();
    wait_until("the server is given up", || servers.given_up().is_some());
    let reason = servers.given_up().unwrap();
    assert!(reason.starts_with("a server ended 6 times"), "{reason}");
    assert!(reason.ends_with("broken"), "{reason}");
    assert_eq!(servers.restarts(), 5);
}
