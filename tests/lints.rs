//! Formatting, lints and types of both languages; a warning fails the test.

use runtime::servers::libmujoco;

use crate::harness::{cargo, python, repository, succeed};

/// The folders that contain Python code.
const PYTHON_FOLDERS: [&str; 3] = ["env-server", "agent/training", "tests"];

#[test]
fn rust_is_formatted() {
    succeed(cargo().args(["fmt", "--all", "--check"]));
}

#[test]
fn rust_has_no_warnings() {
    let mut clippy = cargo();
    let libraries = libmujoco(repository(), python()).expect("the package mujoco has a library");
    clippy
        .env("MUJOCO_DYNAMIC_LINK_DIR", libraries)
        .args(["clippy", "--quiet", "--workspace", "--all-targets"])
        .args(["--features", "simulator/mujoco"]);
    if !cfg!(debug_assertions) {
        clippy.arg("--release");
    }
    succeed(clippy.args(["--", "-D", "warnings"]));
}

#[test]
fn python_is_formatted_and_has_no_warnings() {
    for verb in [&["check"][..], &["format", "--check"]] {
        let mut ruff = python().command();
        ruff.current_dir(repository()).args(["-m", "ruff"]).args(verb).arg("--no-cache");
        succeed(ruff.args(PYTHON_FOLDERS));
    }
}

#[test]
fn python_types_are_correct() {
    let mut mypy = python().command();
    mypy.current_dir(repository().join("env-server"));
    succeed(mypy.args(["-m", "mypy", "--strict", "rever_env", "tests", "env.py"]));
}

#[test]
fn types_of_the_training_are_correct_without_pytorch() {
    let mut mypy = python().command();
    mypy.current_dir(repository().join("agent/training"));
    mypy.args(["-m", "mypy", "--strict", "."]);
    // PyTorch is several times larger than everything else that the tests install. Without it, its
    // values have any type.
    mypy.args(["--ignore-missing-imports", "--no-warn-unused-ignores", "--no-warn-return-any"]);
    succeed(mypy.args(["--allow-subclassing-any", "--allow-untyped-decorators"]));
}
