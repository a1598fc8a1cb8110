//! The subcommands: each file holds the arguments of one and the function that runs it.

mod bench;
mod collect;
mod conformance;
mod demo;
mod digest;
mod doctor;
mod episodes;
mod evaluate;
mod names;
mod report;
mod train;

use std::fmt;
use std::io::IsTerminal;
use std::path::PathBuf;

use anyhow::Result;
use clap::{Parser, Subcommand};
use runtime::servers::Host;
use tracing_subscriber::EnvFilter;

/// Warnings only: progress and results have their own lines. What matters of zenoh's is returned as an error.
const LOG_FILTER_DEFAULT: &str = "warn,zenoh=off";

/// Evaluate reasoning robot policies: sample several candidates per step, verify them, execute the best one.
#[derive(Debug, Parser)]
#[command(name = "rever", version)]
pub struct Program {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Arguments),
    Evaluate(evaluate::Arguments),
    Collect(collect::Arguments),
    Train(train::Arguments),
    Report(report::Arguments),
    Digest(digest::Arguments),
    Doctor(doctor::Arguments),
    Bench(bench::Arguments),
    Conformance(conformance::Arguments),
}

impl Program {
    /// Runs the chosen subcommand to its end.
    pub fn run(self, host: &Host) -> Result<()> {
        match self.command {
            Command::Demo(arguments) => demo::run(arguments, host),
            Command::Evaluate(arguments) => evaluate::run(arguments, host),
            Command::Collect(arguments) => collect::run(arguments, host),
            Command::Train(arguments) => train::run(arguments, host),
            Command::Report(arguments) => report::run(arguments, host),
            Command::Digest(arguments) => digest::run(arguments),
            Command::Doctor(arguments) => doctor::run(arguments, host),
            Command::Bench(arguments) => bench::run(arguments, host),
            Command::Conformance(arguments) => conformance::run(arguments, host),
        }
    }
}

/// Sends the log to standard error; `filter` is in the form of `tracing` and replaces the default.
pub fn start_log(filter: Option<&str>) {
    let filter = EnvFilter::new(filter.unwrap_or(LOG_FILTER_DEFAULT));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
        .init();
}

/// The command line asks for something that there is not; found out before anything was started.
#[derive(Debug)]
pub struct WrongUsage(pub String);

impl fmt::Display for WrongUsage {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0)
    }
}

impl std::error::Error for WrongUsage {}

/// A file that is written at the end of the command, tried before anything is done for it.
pub fn output_file(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    store::check_writable(&path).map_err(|error| format!("{error:#}"))?;
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_cannot_be_written_is_wrong_usage_of_every_command_that_writes_one() {
        let commands: [&[&str]; 9] = [
            &["demo"],
            &["evaluate"],
            &["collect"],
            &["train"],
            &["report", "run"],
            &["doctor"],
            &["conformance"],
            &["bench", "decision"],
            &["bench", "simulators"],
        ];
        for command in commands {
            let words = ["rever"].iter().chain(command).chain(&["--json", "/proc/none/x.json"]);
            let error = Program::try_parse_from(words).expect_err("it cannot be written");
            assert_eq!(error.exit_code(), 2, "{command:?}: {error}");
            let text = error.to_string();
            assert!(text.contains("cannot write /proc/none/x.json"), "{command:?}: {text}");
        }
    }
}
