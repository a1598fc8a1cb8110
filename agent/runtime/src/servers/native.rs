//! The native simulator: built in a checkout, otherwise found next to the program or on PATH.

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
/// Building the whole workspace selects the same features of dependencies as the tests do.
const BUILD: [&str; 7] =
    ["build", "--release", "--workspace", "--features", "simulator/mujoco", "--bin", PROGRAM];

/// The simulator with the MuJoCo library of `python`.
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
    // A program built elsewhere looks for the library at its path on the build machine.
    variables.insert("LD_LIBRARY_PATH".into(), folder.into());
    let assets = installation.package_root().join("assets");
    Ok(ServerProgram::Native { program, assets, variables })
}

/// Builds the program if it is not up to date.
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
    program.context("cargo did not report the path of rever-simulator")
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
            "rever-simulator is not built; any command that starts native servers builds it, such as \
             `rever evaluate --simulator native`"
        );
    }
    bail!(
        "rever-simulator was found neither next to rever nor on PATH; build it in a checkout with \
         `rever evaluate --simulator native` and copy target/release/rever-simulator next to rever"
    )
}

/// The libmujoco of this Python environment.
fn library(python: &PythonEnvironment) -> Result<PathBuf> {
    let find = "import mujoco, pathlib; \
                print(*pathlib.Path(mujoco.__path__[0]).glob('libmujoco.so.*'), sep='\\n')";
    let output = python.command().args(["-c", find]).output();
    let output = output.with_context(|| format!("cannot start {}", python.python.display()))?;
    let lacks = || format!("{} has no mujoco package with libmujoco", python.python.display());
    ensure!(output.status.success(), "{}: {}", lacks(), last_lines(&output));
    let said = String::from_utf8_lossy(&output.stdout);
    Ok(PathBuf::from(said.lines().next().with_context(lacks)?))
}

/// A folder in a checkout with links to this Python environment's libmujoco, under the names that
/// linker and loader use.
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
