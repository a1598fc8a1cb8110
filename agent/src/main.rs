//! The program `rever`: parses the command line, runs one subcommand, prints one error.

use std::process::ExitCode;

use agent::command::Program;
use clap::Parser;

fn main() -> ExitCode {
    let (name, value) = protocol::transport::RUNTIME;
    if std::env::var_os(name).is_none() {
        // SAFETY: no other thread runs yet that could read the environment.
        unsafe { std::env::set_var(name, value) };
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
