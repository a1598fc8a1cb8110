//! The simulators that can be started on this machine.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt;
use std::path::PathBuf;
use std::process::Command;

use clap::ValueEnum;
use serde::Serialize;

use super::python::PythonEnvironment;

/// A simulator. `Python` and `Native` give the same bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Simulator {
    /// MuJoCo from Python (`python -m rever_env serve`).
    #[default]
    Python,
    /// MuJoCo from Rust (`rever-simulator`), equal to python bit for bit; a checkout builds it on first use.
    Native,
    /// The Bridge tasks in robosuite with its controllers; rever sets up the packages on first use.
    Robosuite,
}

impl fmt::Display for Simulator {
    /// The name on the command line.
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let value = self.to_possible_value();
        formatter.write_str(value.as_ref().map_or("", |value| value.get_name()))
    }
}

/// A server program that is ready to be started.
#[derive(Debug, Clone)]
pub enum ServerProgram {
    /// The package `rever_env`.
    Python(PythonEnvironment),
    /// The package `rever_env` with the Bridge tasks in robosuite.
    Robosuite(PythonEnvironment),
    /// The program `rever-simulator`.
    Native {
        /// The program.
        program: PathBuf,
        /// Folder of the scenes and tasks.toml.
        assets: PathBuf,
        /// All environment variables of the process.
        variables: BTreeMap<OsString, OsString>,
    },
}

impl ServerProgram {
    /// Additional arguments of its `serve` command.
    pub fn serve_arguments(&self) -> &'static [&'static str] {
        match self {
            ServerProgram::Robosuite(_) => &["--robosuite", "bridge"],
            ServerProgram::Python(_) | ServerProgram::Native { .. } => &[],
        }
    }

    /// The program without a subcommand.
    pub fn command(&self) -> Command {
        match self {
            ServerProgram::Python(environment) | ServerProgram::Robosuite(environment) => {
                let mut command = environment.command();
                command.args(["-m", "rever_env"]);
                command
            }
            ServerProgram::Native { program, assets, variables } => {
                let mut command = Command::new(program);
                command.env_clear().envs(variables).arg("--assets").arg(assets);
                command
            }
        }
    }
}
