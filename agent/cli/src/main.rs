//! The program `rever`: parses the command line, runs one subcommand, prints one error.
//!
//! ```text
//! main ─▶ command::evaluate ─▶ Experiment::run ─▶ Rollout::run ─▶ EpisodeRun::run ─▶ Decider::decide
//! ```

mod bench;
mod build_info;
mod command;
mod files;
mod panics;

use std::process::ExitCode;

use clap::Parser;
use command::Program;
use runtime::experiment::UnknownTask;
use runtime::servers::Host;

fn main() -> ExitCode {
    panics::report_panics();
    // Wrong usage ends inside `parse`, with status 2 and a message that says what was expected.
    let program = Program::parse();
    #[expect(clippy::disallowed_methods, reason = "this is main")]
    let filter = std::env::var("REVER_LOG").ok();
    command::start_log(filter.as_deref());
    match program.run(&host()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            let is_usage = error.is::<command::WrongUsage>() || error.is::<UnknownTask>();
            ExitCode::from(if is_usage { 2 } else { 1 })
        }
    }
}

/// All that is read of the surroundings, apart from the arguments.
fn host() -> Host {
    Host {
        program: std::env::current_exe().ok(),
        folder: std::env::current_dir().ok(),
        variables: std::env::vars_os().collect(),
    }
}
