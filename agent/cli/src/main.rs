//! The program `rever`: parses the command line, runs one subcommand, prints one error.
//!
//! ```text
//! main ─▶ command::evaluate ─▶ Experiment::run ─▶ Rollout::run ─▶ EpisodeRun::run ─▶ Decider::decide
//! ```

mod bench;
mod build_info;
mod command;

use std::process::ExitCode;

use clap::Parser;
use command::Program;

fn main() -> ExitCode {
    exit_quietly_on_broken_pipe();
    // Wrong usage ends inside `parse`, with status 2 and a message that says what was expected.
    let program = Program::parse();
    #[expect(clippy::disallowed_methods, reason = "this is main")]
    let filter = std::env::var("REVER_LOG").ok();
    command::start_log(filter.as_deref());
    match program.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(if error.is::<command::WrongUsage>() { 2 } else { 1 })
        }
    }
}

/// In `rever ... | head`, `head` has seen enough: that ends the program and is no defect to be reported.
fn exit_quietly_on_broken_pipe() {
    let report = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        let message = panic.payload_as_str().unwrap_or_default();
        if !(message.starts_with("failed printing to std") && message.contains("Broken pipe")) {
            report(panic);
        }
    }));
}
