//! A shell script in the place of Python shows what the supervisor does with each kind of server.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use super::*;
use crate::setup::PythonEnvironment;

const WAIT_SECS: u64 = 20;

/// `script` runs as the server; `$PYTHONPATH` is a folder of its own.
fn start(folder: &Path, script: &str, count: usize) -> Result<LocalServers> {
    let python = folder.join("python");
    std::fs::write(&python, format!("#!/bin/sh\n{script}\n")).unwrap();
    std::fs::set_permissions(&python, std::fs::Permissions::from_mode(0o755)).unwrap();
    let program =
        ServerProgram::Python(PythonEnvironment { python, package_root: folder.to_owned() });
    let options = LocalServerOptions {
        count,
        connect: "tcp/127.0.0.1:1".to_owned(),
        fleet: "test".to_owned(),
        sessions_each: 1,
    };
    LocalServers::start(program, &options)
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

#[test]
fn all_are_ready_and_none_outlives_the_value() {
    let folder = tempfile::tempdir().unwrap();
    let servers = start(folder.path(), "echo noise; echo ready $$; exec sleep 1000", 2).unwrap();
    let processes = servers.process_ids();
    let names: Vec<String> = processes.iter().map(u32::to_string).collect();
    assert_eq!(servers.server_ids(), names);
    drop(servers);
    assert!(!processes.into_iter().any(is_alive));
}

#[test]
fn a_server_that_never_starts_is_an_error_with_its_last_words() {
    let folder = tempfile::tempdir().unwrap();
    let error = start(folder.path(), "echo no display >&2; exit 3", 1).unwrap_err().to_string();
    assert_eq!(error, "a server did not start: exit status: 3\nno display");
}

#[test]
fn one_that_dies_or_is_replaced_is_started_again() {
    let folder = tempfile::tempdir().unwrap();
    let servers = start(folder.path(), "echo ready $$; exec sleep 1000", 1).unwrap();
    let first = servers.server_ids();
    servers.replace(&first[0]);
    wait_until("the server is back", || {
        let now = servers.server_ids();
        now.len() == 1 && now != first
    });
    assert_eq!((servers.restarts(), servers.given_up()), (1, None));
}

#[test]
fn one_that_keeps_dying_is_given_up() {
    let folder = tempfile::tempdir().unwrap();
    let servers = start(folder.path(), "echo ready $$; echo out of memory >&2", 1).unwrap();
    wait_until("the server is given up", || servers.given_up().is_some());
    let reason = servers.given_up().unwrap();
    assert!(reason.starts_with("a server died 6 times"), "{reason}");
    assert!(reason.ends_with("out of memory"), "{reason}");
    assert_eq!(servers.restarts(), RESTARTS_MAX);
}
