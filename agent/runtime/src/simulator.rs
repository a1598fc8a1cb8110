//! The simulators whose servers can be started on this machine, and what each needs before that.

use std::fmt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};
use clap::ValueEnum;
use serde::Serialize;
use serde_json::Value;

use crate::setup::{self, PythonEnvironment};

/// One of ours. `Python` and `Native` give the same bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Simulator {
    /// `python -m rever_env serve`.
    #[default]
    Python,
    /// `rever-simulator`, built when it is first asked for.
    Native,
    /// The Bridge tasks in robosuite, with its controllers; packages of its own are set up when it is first asked for.
    Robosuite,
}

impl fmt::Display for Simulator {
    /// As the command line has it.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let value = self.to_possible_value();
        formatter.write_str(value.as_ref().map_or("", |value| value.get_name()))
    }
}

/// A program that serves worlds, ready to be started.
#[derive(Debug, Clone)]
pub enum ServerProgram {
    /// The package `rever_env`.
    Python(PythonEnvironment),
    /// The same, with the Bridge tasks in robosuite.
    Robosuite(PythonEnvironment),
    /// The program `rever-simulator`.
    Native {
        /// The program.
        program: PathBuf,
        /// Scenes and tasks.toml.
        assets: PathBuf,
    },
}

impl ServerProgram {
    /// Makes sure that the simulator can be started on `python`; the native one is linked with its MuJoCo.
    pub fn prepare(simulator: Simulator, python: PythonEnvironment) -> Result<ServerProgram> {
        Ok(match simulator {
            Simulator::Python => ServerProgram::Python(python),
            Simulator::Robosuite => ServerProgram::Robosuite(python),
            Simulator::Native => native(&setup::repository()?, &python)?,
        })
    }

    /// What its `serve` needs to be told beside the common options.
    pub fn serve_arguments(&self) -> Vec<&'static str> {
        match self {
            ServerProgram::Robosuite(_) => vec!["--robosuite", "bridge"],
            ServerProgram::Python(_) | ServerProgram::Native { .. } => Vec::new(),
        }
    }

    /// The program without its subcommand.
    pub fn command(&self) -> Command {
        match self {
            ServerProgram::Python(environment) | ServerProgram::Robosuite(environment) => {
                let mut command = environment.command();
                command.args(["-m", "rever_env"]);
                command
            }
            ServerProgram::Native { program, assets } => {
                let mut command = Command::new(program);
                // Frames must not depend on the graphics card that this machine may have.
                command.env("LIBGL_ALWAYS_SOFTWARE", "1").arg("--assets").arg(assets);
                command
            }
        }
    }
}

/// Builds `rever-simulator` unless it is there already.
fn native(repository: &Path, python: &PythonEnvironment) -> Result<ServerProgram> {
    let libraries = libmujoco(repository, python)?;
    let mut cargo = Command::new("cargo");
    cargo
        .current_dir(repository)
        .env("MUJOCO_DYNAMIC_LINK_DIR", &libraries)
        // With the whole workspace, dependencies have the features that the tests build them with.
        .args(["build", "--release", "--workspace", "--features", "simulator/mujoco"])
        .args(["--bin", "rever-simulator", "--message-format", "json-render-diagnostics"])
        .stderr(Stdio::inherit());
    let output = cargo.output().context("cannot start cargo to build rever-simulator")?;
    ensure!(output.status.success(), "rever-simulator could not be built: {}", output.status);
    let said = String::from_utf8_lossy(&output.stdout);
    let messages = said.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let program = messages
        .filter(|message| message["target"]["name"] == "rever-simulator")
        .find_map(|message| message["executable"].as_str().map(PathBuf::from));
    Ok(ServerProgram::Native {
        program: program.context("cargo built rever-simulator and did not say where")?,
        assets: repository.join("env-server/assets"),
    })
}

/// A folder with the libmujoco of this Python under the names that linker and loader look for.
pub fn libmujoco(repository: &Path, python: &PythonEnvironment) -> Result<PathBuf> {
    let find = "import mujoco, pathlib; \
                print(*pathlib.Path(mujoco.__path__[0]).glob('libmujoco.so.*'), sep='\\n')";
    let output = python.command().args(["-c", find]).output().context("cannot start python")?;
    let said = String::from_utf8_lossy(&output.stdout);
    let library = said.lines().next().map(Path::new).with_context(|| {
        format!("the package mujoco of {} has no libmujoco.so.*", python.python.display())
    })?;
    let folder = repository.join(".venv/libmujoco");
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot create {}", folder.display()))?;
    let name = library.file_name().context("a library has a name")?;
    for link in [folder.join("libmujoco.so"), folder.join(name)] {
        if std::fs::read_link(&link).is_ok_and(|target| target == library) {
            continue;
        }
        // A link to another version, or none.
        let _ = std::fs::remove_file(&link);
        std::os::unix::fs::symlink(library, &link)
            .with_context(|| format!("cannot create {}", link.display()))?;
    }
    Ok(folder)
}
