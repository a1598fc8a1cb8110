//! The program `rever`: parses the command line, runs one subcommand, prints one error.

use std::process::ExitCode;

use agent::command::Program;
use clap::Parser;
use protocol::transport::{RUNTIME_POOL, RUNTIME_VARIABLE};

fn main() -> ExitCode {
    if std::env::var_os(RUNTIME_VARIABLE).is_none() {
        // SAFETY: no other thread runs yet that could read the environment.
        unsafe { std::env::set_var(RUNTIME_VARIABLE, RUNTIME_POOL) };
    }
    // Wrong usage ends inside `parse`, with status 2 and a message that says what was expected.
    let program = Program::parse();
    #[expect(clippy::disallowed_methods, reason = "this is main")]
    let filter = std::env::var("REVER_LOG").ok();
    agent::command::start_log(filter.as_deref());
    match program.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(1)
        }
    }
}
