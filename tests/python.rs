//! The tests of the Python package.

use std::io::Write;

use crate::harness::{python, repository, succeed};

#[test]
fn the_environment_server_passes_its_tests() {
    let mut pytest = python().command();
    pytest.current_dir(repository().join("env-server"));
    let said = succeed(pytest.args(["-m", "pytest", "--quiet"]));
    // Written past the capture of the test runner, so that every run shows how many tests passed.
    let closing = said.lines().next_back().unwrap_or_default();
    writeln!(std::io::stderr(), "pytest: {closing}").expect("standard error is open");
}
