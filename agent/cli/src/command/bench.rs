//! `rever bench`: benchmarks of decisions, the policy server, episodes, the wire and simulators.

mod decision;
mod parity;
mod policy_server;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::{Args, Subcommand};
use evaluation::table::aligned;

use runtime::servers::{Host, LocalSource, ServerSource, Simulator};

use crate::bench::{self, SimulatorsBench, ThroughputBench, WireBench};
use crate::build_info;
use crate::command::cache;
use crate::command::policy::PolicyArguments;
use crate::files;

/// Benchmark decisions, the policy server, episodes, the wire and simulators on this machine
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(subcommand)]
    part: Part,
}

#[derive(Debug, Subcommand)]
enum Part {
    Decision(decision::Arguments),
    Parity(parity::Arguments),
    Throughput(ThroughputArguments),
    PolicyServer(policy_server::Arguments),
    Wire(WireArguments),
    Simulators(SimulatorsArguments),
}

/// Measure concurrent episodes: decisions and episodes per second, and the memory of this process
#[derive(Debug, Args)]
struct ThroughputArguments {
    /// Numbers of concurrent episodes, separated by commas
    #[arg(long, value_delimiter = ',', default_value = "1,2,4,8,16",
          value_parser = clap::value_parser!(u16).range(1..=256))]
    sessions: Vec<u16>,
    /// Decisions to count for each number of sessions
    #[arg(long, default_value_t = 2_000, value_parser = clap::value_parser!(u64).range(1..))]
    decisions: u64,
    /// Candidates per decision
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=256))]
    candidates: u32,
    /// Server processes to start
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..=64))]
    servers: u16,
    /// Simulator of these servers
    #[arg(long, value_enum, default_value_t)]
    simulator: Simulator,
    /// File of the verifier [default: verifier.safetensors in the policy's folder, if it exists]
    #[arg(long, value_name = "FILE", help_heading = "Policy and verifier")]
    verifier: Option<PathBuf>,
    /// Python interpreter for the servers, which must have env-server's packages [default: an environment that rever sets up]
    #[arg(long, value_name = "FILE")]
    python: Option<PathBuf>,
    /// Also write the figures to this file
    #[arg(long, value_name = "FILE", value_parser = super::output_file)]
    json: Option<PathBuf>,
    #[command(flatten)]
    policy: PolicyArguments,
}

/// Measure the network's share of a control step: its time minus the simulator's
#[derive(Debug, Args)]
struct WireArguments {
    /// Numbers of concurrent sessions on one server, separated by commas
    #[arg(long, value_delimiter = ',', default_value = "1,8,32",
          value_parser = clap::value_parser!(u16).range(1..=64))]
    sessions: Vec<u16>,
    /// Simulators to measure, separated by commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "native,python")]
    simulator: Vec<Simulator>,
    #[command(flatten)]
    steps: StepsArguments,
}

/// Compare control steps of the Python and the native server, with and without an image
#[derive(Debug, Args)]
struct SimulatorsArguments {
    /// Numbers of concurrent sessions on each server, separated by commas
    #[arg(long, value_delimiter = ',', default_value = "1,2,4,8",
          value_parser = clap::value_parser!(u16).range(1..=64))]
    sessions: Vec<u16>,
    #[command(flatten)]
    steps: StepsArguments,
}

/// The arguments that both benchmarks of control steps share
#[derive(Debug, Args)]
struct StepsArguments {
    /// Control steps per session
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// Height and width of the image
    #[arg(long, default_value_t = 224, value_parser = clap::value_parser!(u32).range(1..=1024))]
    side: u32,
    /// Python interpreter for the servers, which must have env-server's packages [default: an environment that rever sets up]
    #[arg(long, value_name = "FILE")]
    python: Option<PathBuf>,
    /// Also write the figures to this file
    #[arg(long, value_name = "FILE", value_parser = super::output_file)]
    json: Option<PathBuf>,
}

/// Runs the chosen benchmark and prints a table.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    match arguments.part {
        Part::Decision(arguments) => decision::run(arguments, host),
        Part::Parity(arguments) => parity::run(&arguments, host),
        Part::Throughput(arguments) => throughput(arguments, host),
        Part::PolicyServer(arguments) => policy_server::run(arguments, host),
        Part::Wire(arguments) => wire(arguments, host),
        Part::Simulators(arguments) => simulators(arguments, host),
    }?;
    println!("commit {}", build_info::build().commit_text());
    Ok(())
}

fn wire(arguments: WireArguments, host: &Host) -> Result<()> {
    let sessions: Vec<usize> = arguments.sessions.iter().copied().map(usize::from).collect();
    let (steps, side) = (arguments.steps.steps as usize, arguments.steps.side);
    let mut rows = Vec::new();
    for &simulator in &arguments.simulator {
        let servers = servers(host, 1, simulator, arguments.steps.python.clone())?;
        rows.extend(WireBench { servers: &servers, sessions: &sessions, steps, side }.run()?);
    }
    if let Some(path) = &arguments.steps.json {
        write_json(path, serde_json::json!({ "side": side, "rows": rows }))?;
    }
    let row = |row: &bench::WireRow| {
        vec![
            row.simulator.to_string(),
            row.sessions.to_string(),
            row.steps.to_string(),
            format!("{:.3}", row.step_ms_p50),
            format!("{:.3}", row.simulator_ms_p50),
            format!("{:.3}", row.wire_ms_p50),
            format!("{:.3}", row.wire_ms_p95),
            format!("{:.1} %", 100.0 * row.wire_ms_p50 / row.step_ms_p50),
            format!("{:.3}", row.repeat_ms_p50),
            format!("{:.3}", row.bare_ms_p50),
            format!("{:.1}", row.reply_bytes_p50 / 1e3),
        ]
    };
    let head = [
        "",
        "sessions",
        "steps",
        "step",
        "simulator",
        "wire",
        "p95",
        "share",
        "repeat",
        "bare",
        "kB",
    ];
    print_table(&head, rows.iter().map(row));
    println!(
        "Medians in ms per step over all sessions, {side} x {side} pixels, one server per simulator. wire: step minus\n\
         simulator; share: wire / step; repeat: last reply resent; bare: as many bytes through a socket; kB: reply size"
    );
    Ok(())
}

fn simulators(arguments: SimulatorsArguments, host: &Host) -> Result<()> {
    let servers = servers(host, 1, Simulator::Python, arguments.steps.python.clone())?;
    let sessions: Vec<usize> = arguments.sessions.iter().copied().map(usize::from).collect();
    let steps = arguments.steps.steps as usize;
    let bench = SimulatorsBench {
        servers: &servers,
        sessions: &sessions,
        steps,
        side: arguments.steps.side,
    };
    let rows = bench.run()?;
    if let Some(path) = &arguments.steps.json {
        write_json(path, serde_json::json!({ "rows": rows }))?;
    }
    let row = |row: &bench::SimulatorsRow| {
        let (python, native) = (row.python_steps_per_second, row.native_steps_per_second);
        vec![
            row.side.to_string(),
            row.sessions.to_string(),
            row.steps.to_string(),
            format!("{python:.1}"),
            format!("{native:.1}"),
            format!("{:.2}", native / python),
        ]
    };
    let head = ["pixels", "sessions", "steps", "python", "native", "ratio"];
    print_table(&head, rows.iter().map(row));
    println!(
        "control steps per second of one server process, measured alternately; 0 pixels: no rendering"
    );
    Ok(())
}

/// Local servers in a fleet of their own, so that no other server takes part.
fn servers(
    host: &Host,
    count: usize,
    simulator: Simulator,
    python: Option<PathBuf>,
) -> Result<ServerSource> {
    let installation = files::installation(host)?;
    Ok(ServerSource {
        local: Some(LocalSource { count, simulator, python, installation }),
        connect: Vec::new(),
        listen: Vec::new(),
        fleet: "bench".to_owned(),
    })
}

fn throughput(arguments: ThroughputArguments, host: &Host) -> Result<()> {
    let loaded = arguments.policy.load(host)?;
    let verifier = loaded.verifier(arguments.verifier)?;
    let count = usize::from(arguments.servers);
    let servers = servers(host, count, arguments.simulator, arguments.python)?;
    let PolicyArguments { device, kv_cache, .. } = arguments.policy;
    let fitting = |&wanted: &u16| match loaded.network() {
        Some(policy) => cache::sessions(policy, device, kv_cache, wanted, arguments.candidates),
        None => Ok(wanted),
    };
    let sessions = arguments.sessions.iter().map(|wanted| fitting(wanted).map(usize::from));
    let mut sessions: Vec<usize> = sessions.collect::<Result<_>>()?;
    sessions.dedup();
    let bench = ThroughputBench {
        policy: loaded.policy,
        verifier,
        servers: &servers,
        sessions: &sessions,
        decisions: arguments.decisions,
        candidates: arguments.candidates,
    };
    let rows = bench.run()?;
    if let Some(path) = &arguments.json {
        write_json(path, serde_json::json!({ "candidates": arguments.candidates, "rows": rows }))?;
    }
    let row = |row: &bench::ThroughputRow| {
        // If no episode has ended, the rate is unknown.
        let episodes = (row.episodes_per_second > 0.0).then_some(row.episodes_per_second);
        vec![
            row.sessions.to_string(),
            row.decisions.to_string(),
            format!("{:.1}", row.decisions_per_second),
            episodes.map_or_else(|| "-".to_owned(), |rate| format!("{rate:.2}")),
            format!("{:.1}", row.memory_mb_before),
            format!("{:.1}", row.memory_mb_after),
        ]
    };
    let head = ["sessions", "decisions", "decisions/s", "episodes/s", "MB before", "MB after"];
    print_table(&head, rows.iter().map(row));
    println!(
        "{} candidates, strategy {}, {} server processes",
        arguments.candidates,
        bench.strategy(),
        arguments.servers
    );
    Ok(())
}

/// Prints columns of numbers with a header.
fn print_table(head: &[&str], rows: impl Iterator<Item = Vec<String>>) {
    let head = head.iter().map(|name| (*name).to_owned()).collect();
    print!("{}", aligned(&std::iter::once(head).chain(rows).collect::<Vec<_>>()));
}

/// Writes the figures as JSON, with the commit of this build.
fn write_json(path: &Path, mut figures: serde_json::Value) -> Result<()> {
    figures["commit"] = build_info::build().commit_text().into();
    let text = serde_json::to_string_pretty(&figures)?;
    std::fs::write(path, text + "\n").with_context(|| format!("cannot write {}", path.display()))
}
