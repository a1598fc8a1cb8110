//! The native simulator: built in a checkout, found beside the program or on PATH elsewhere.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

use super::installation::{Installation, Missing};
use super::program::ServerProgram;
use super::python::{PythonEnvironment, last_lines};
use super::variables;

const PROGRAM: &str = "rever-simulator";
/// With the whole workspace, dependencies have the features that the tests build them with.
const BUILD: [&str; 7] =
    ["build", "--release", "--workspace", "--features", "simulator/mujoco", "--bin", PROGRAM];

/// The simulator with the MuJoCo of `python`.
pub(super) fn prepare(
    installation: &Installation,
    python: &PythonEnvironment,
    missing: Missing,
) -> Result<ServerProgram> {
    let library = library(python)?;
    let program = if installation.is_checkout() && missing == Missing::Install {
        build(&installation.root, python)?
    } else {
        find(installation)?
    };
    let mut variables = variables::for_server(&installation.host.variables);
    let folder = library.parent().context("a library is in a folder")?;
    // A program that was built elsewhere looks for the library where it was then.
    variables.insert("LD_LIBRARY_PATH".into(), folder.into());
    let assets = installation.package_root().join("assets");
    Ok(ServerProgram::Native { program, assets, variables })
}

/// Builds the program unless it is up to date.
fn build(root: &Path, python: &PythonEnvironment) -> Result<PathBuf> {
    let libraries = libmujoco(root, python)?;
    let mut cargo = Command::new("cargo");
    cargo
        .current_dir(root)
        .env("MUJOCO_DYNAMIC_LINK_DIR", &libraries)
        .args(BUILD)
        .args(["--message-format", "json-render-diagnostics"])
        .stderr(Stdio::inherit());
    let output = cargo.output().context("cannot start cargo to build rever-simulator")?;
    ensure!(output.status.success(), "cannot build rever-simulator: cargo: {}", output.status);
    let said = String::from_utf8_lossy(&output.stdout);
    let messages = said.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let program = messages
        .filter(|message| message["target"]["name"] == PROGRAM)
        .find_map(|message| message["executable"].as_str().map(PathBuf::from));
    program.context("cargo built rever-simulator and did not say where")
}

fn find(installation: &Installation) -> Result<PathBuf> {
    let host = &installation.host;
    let beside = host.program.as_deref().and_then(Path::parent).map(Path::to_owned);
    let path = host.variables.get(OsStr::new("PATH")).cloned().unwrap_or_default();
    let built = installation.is_checkout().then(|| installation.root.join("target/release"));
    let folders = beside.into_iter().chain(built).chain(std::env::split_paths(&path));
    let mut files = folders.map(|folder| folder.join(PROGRAM));
    if let Some(program) = files.find(|file| file.is_file()) {
        return Ok(program);
    }
    if installation.is_checkout() {
        bail!(
            "rever-simulator is not built; any other command with --simulator native builds it, such as \
             `rever evaluate --simulator native`"
        );
    }
    bail!(
        "rever-simulator is neither beside rever nor on PATH: it is built in a checkout of rever, \
         there by `rever evaluate --simulator native`; copy it from target/release beside rever"
    )
}

/// The libmujoco of this Python.
fn library(python: &PythonEnvironment) -> Result<PathBuf> {
    let find = "import mujoco, pathlib; \
                print(*pathlib.Path(mujoco.__path__[0]).glob('libmujoco.so.*'), sep='\\n')";
    let output = python.command().args(["-c", find]).output();
    let output = output.with_context(|| format!("cannot start {}", python.python.display()))?;
    let lacks = || format!("{} has no package mujoco with its library", python.python.display());
    ensure!(output.status.success(), "{}: {}", lacks(), last_lines(&output));
    let said = String::from_utf8_lossy(&output.stdout);
    Ok(PathBuf::from(said.lines().next().with_context(lacks)?))
}

/// A folder in a checkout with the libmujoco of this Python under the names that linker and loader look for.
pub fn libmujoco(root: &Path, python: &PythonEnvironment) -> Result<PathBuf> {
    let library = library(python)?;
    let folder = root.join(".venv/libmujoco");
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot create {}", folder.display()))?;
    let name = library.file_name().context("a library has a name")?;
    for link in [folder.join("libmujoco.so"), folder.join(name)] {
        if std::fs::read_link(&link).is_ok_and(|target| target == library) {
            continue;
        }
        // A link to another version, or none.
        let _ = std::fs::remove_file(&link);
        std::os::unix::fs::symlink(&library, &link)
            .with_context(|| format!("cannot create {}", link.display()))?;
    }
    Ok(folder)
}
