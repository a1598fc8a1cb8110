//! `rever-simulator`: the world of `rever_env`, natively and behind the same protocol.
//!
//! ```text
//! serving     the network, and how it ends       trace     every number of an episode, to be compared
//!   server    leases, queue, heartbeat           session   numbered requests, slots
//!   worlds    idle worlds                        world     one task in MuJoCo: reset, step, save, restore
//!     mjcf, model, controller, success, expert, layout, camera    tasks   assets/tasks.toml
//! ```

mod camera;
mod controller;
mod expert;
mod fault;
mod layout;
mod mjcf;
mod model;
mod server;
mod serving;
mod session;
mod success;
mod tasks;
mod trace;
mod world;
mod worlds;

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use clap::{Parser, Subcommand};
use protocol::transport::{RUNTIME_POOL, RUNTIME_SINGLE, RUNTIME_VARIABLE};

/// The world of rever_env, natively.
#[derive(Parser)]
#[command(version)]
struct Program {
    /// The folder with tasks.toml and the scenes.
    #[arg(long, value_name = "FOLDER")]
    assets: PathBuf,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Serve(serving::Arguments),
    Trace(trace::Arguments),
}

fn main() -> ExitCode {
    // What an agent has set for itself comes down to the servers that it starts, and is no user's choice.
    let defaults = [
        (RUNTIME_VARIABLE, RUNTIME_SINGLE, RUNTIME_POOL),
        (camera::DRAWING_THREADS.0, camera::DRAWING_THREADS.1, camera::DRAWING_THREADS.1),
    ];
    for (name, value, inherited) in defaults {
        if std::env::var_os(name).is_none_or(|chosen| chosen == inherited) {
            // SAFETY: no other thread runs yet that could read the environment.
            unsafe { std::env::set_var(name, value) };
        }
    }
    let program = Program::parse();
    tracing_subscriber::fmt().with_writer(std::io::stderr).with_target(false).init();
    match run(program) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(program: Program) -> Result<()> {
    let tasks = tasks::load(&program.assets)?;
    match program.command {
        Command::Serve(arguments) => serving::serve(arguments, tasks),
        Command::Trace(arguments) => trace::trace(arguments, tasks),
    }
}
