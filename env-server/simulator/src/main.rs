//! `rever-simulator`: the native simulator, with the same protocol and environments as `rever_env`.
//!
//! ```text
//! serving     network, start and shutdown        trace     all numbers of an episode
//!   server    leases, heartbeat                  session   numbered requests, slots
//!     inbox, outbox       queues to and from the simulation thread
//!   worlds    idle environments                  world     one task in MuJoCo: reset, step, save, restore
//!     mjcf, model, controller, success, expert, layout, camera    tasks, assets   tasks.toml and the scenes
//! ```

mod assets;
mod camera;
mod controller;
mod expert;
mod fault;
mod inbox;
mod layout;
mod mjcf;
mod model;
mod outbox;
mod server;
mod serving;
mod session;
mod success;
mod tasks;
mod trace;
mod world;
mod worlds;

use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Result;
use assets::Assets;
use clap::{Parser, Subcommand};
use tracing_subscriber::EnvFilter;

/// The Bridge tasks in MuJoCo: environment server and traces
#[derive(Parser)]
#[command(version)]
struct Program {
    /// Read tasks.toml and the scenes from this folder instead of the built-in ones.
    #[arg(long, value_name = "FOLDER")]
    assets: Option<PathBuf>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Serve(serving::Arguments),
    Trace(trace::Arguments),
}

/// zenoh's log messages below the level error contain source locations, which are paths on the
/// machine that built the program.
const LOG_FILTER: &str = "info,zenoh=error,zenoh_transport=off,zenoh_link=off,zenoh_link_tcp=off";

fn main() -> ExitCode {
    let (name, value) = camera::DRAWING_THREADS;
    if std::env::var_os(name).is_none() {
        // SAFETY: no other thread that could read the environment runs yet.
        unsafe { std::env::set_var(name, value) };
    }
    let program = Program::parse();
    tracing_subscriber::fmt()
        .with_env_filter(EnvFilter::new(LOG_FILTER))
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr)
        .with_target(false)
        .init();
    match run(program) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(program: Program) -> Result<()> {
    let tasks = tasks::load(&program.assets.map_or(Assets::BuiltIn, Assets::Folder))?;
    match program.command {
        Command::Serve(arguments) => serving::serve(arguments, tasks),
        Command::Trace(arguments) => trace::trace(arguments, tasks),
    }
}
