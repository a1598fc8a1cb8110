//! The subcommands: each file holds the arguments of one and the function that runs it.

mod bench;
mod collect;
mod conformance;
mod demo;
mod doctor;
mod episodes;
mod evaluate;
mod report;
mod train;

use anyhow::Result;
use clap::{Parser, Subcommand};
use tracing_subscriber::EnvFilter;

/// Warnings only: progress and results have their own lines.
const LOG_FILTER_DEFAULT: &str = "warn,zenoh=error,zenoh_transport=error,zenoh_link=error";

/// Robot policies that think aloud, sampled several times per step and chosen by a learned verifier.
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
    Doctor(doctor::Arguments),
    Bench(bench::Arguments),
    Conformance(conformance::Arguments),
}

impl Program {
    /// Runs the chosen subcommand to its end.
    pub fn run(self) -> Result<()> {
        match self.command {
            Command::Demo(arguments) => demo::run(arguments),
            Command::Evaluate(arguments) => evaluate::run(arguments),
            Command::Collect(arguments) => collect::run(arguments),
            Command::Train(arguments) => train::run(arguments),
            Command::Report(arguments) => report::run(arguments),
            Command::Doctor(arguments) => doctor::run(arguments),
            Command::Bench(arguments) => bench::run(arguments),
            Command::Conformance(arguments) => conformance::run(arguments),
        }
    }
}

/// Sends the log to standard error; `filter` is in the form of `tracing` and replaces the default.
pub fn start_log(filter: Option<&str>) {
    let filter = EnvFilter::new(filter.unwrap_or(LOG_FILTER_DEFAULT));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
}
