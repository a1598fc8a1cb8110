//! Runs the tests of the Python package.

use std::io::Write;

use runtime::servers::{Missing, PythonEnvironment, simulators_environment};

use crate::harness::{installation, python, repository, succeed};

#[test]
fn the_environment_server_passes_its_tests() {
    pytest(python(), &[]);
}

#[test]
fn the_other_simulators_pass_their_tests() {
    let environment = simulators_environment(&installation(), Missing::Install)
        .expect("the simulators are set up");
    let files = ["test_robosuite", "test_motion", "test_gymnasium_world", "test_surroundings"];
    let files = files.map(|name| format!("tests/{name}.py"));
    pytest(&environment, &files.each_ref().map(String::as_str));
}

fn pytest(environment: &PythonEnvironment, files: &[&str]) {
    let mut pytest = environment.command();
    pytest.current_dir(repository().join("env-server"));
    let said = succeed(pytest.args(["-m", "pytest", "--quiet"]).args(files));
    // Written past the output capture of the test runner, so that every run shows how many tests
    // passed.
    let closing = said.lines().next_back().unwrap_or_default();
    writeln!(std::io::stderr(), "pytest: {closing}").expect("standard error is open");
}
