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
use runtime::experiment::Stopped;
use runtime::servers::Host;

fn main() -> ExitCode {
    panics::report_panics();
    // On wrong usage `parse` prints what was expected and exits with status 2.
    let program = Program::parse();
    #[expect(clippy::disallowed_methods, reason = "this is main")]
    let variable = |name| std::env::var(name).ok().filter(|value| !value.is_empty());
    program.start_log(variable("REVER_LOG").as_deref(), variable("NO_COLOR").is_none());
    match program.run(&host()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(status_of(&error))
        }
    }
}

/// The exit status: 2 for wrong usage, 130 after Ctrl-C, 1 for any other error.
fn status_of(error: &anyhow::Error) -> u8 {
    if error.is::<command::WrongUsage>() {
        2
    } else if error.is::<Stopped>() {
        130
    } else {
        1
    }
}

/// Everything that the program reads from its process, apart from the arguments.
fn host() -> Host {
    Host {
        program: std::env::current_exe().ok(),
        folder: std::env::current_dir().ok(),
        variables: std::env::vars_os().collect(),
    }
}
