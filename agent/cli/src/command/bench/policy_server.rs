//! `rever bench policy-server`: the arguments and the table of the benchmark of the policy server's
//! wires.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use runtime::servers::Host;

use super::{print_table, write_json};
use crate::bench::{PolicyServerBench, PolicyServerRow, read_observations, scaled};
use crate::command::output_file;
use crate::command::policy::PolicyArguments;
use crate::files;

/// Measure what the wires of `rever serve-policy` add to a decision, against the same decision in this process
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    policy: PolicyArguments,
    /// File of the verifier [default: verifier.safetensors in the policy's folder, if it exists]
    #[arg(long, value_name = "FILE", help_heading = "Policy and verifier")]
    verifier: Option<PathBuf>,
    /// Candidates per decision
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=256))]
    candidates: u32,
    /// Height and width of the images that clients send
    #[arg(long, default_value_t = 224, value_parser = clap::value_parser!(u16).range(1..=2048))]
    side: u16,
    /// Number of passes over all observations
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Also write the figures to this file
    #[arg(long, value_name = "FILE", value_parser = output_file)]
    json: Option<PathBuf>,
}

/// Runs the benchmark and prints its table.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    let loaded = arguments.policy.load(host)?;
    let verifier = loaded.verifier(arguments.verifier)?;
    let recorded = files::of_checkout(host, "agent/vla/tests/fixtures/bridge-small.safetensors")?;
    let side = usize::from(arguments.side);
    let observations = scaled(read_observations(&recorded)?, (side, side));
    let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
    let bench = PolicyServerBench {
        policy: loaded.policy,
        verifier,
        observations: &observations,
        candidates: arguments.candidates,
        rounds: arguments.rounds as usize,
        runtime: &runtime,
    };
    let rows = bench.run()?;
    if let Some(path) = &arguments.json {
        write_json(path, serde_json::json!({ "side": side, "rows": rows }))?;
    }
    let row = |row: &PolicyServerRow| {
        vec![
            row.wire.to_owned(),
            row.decisions.to_string(),
            format!("{:.1}", row.request_bytes as f64 / 1e3),
            format!("{:.2}", row.decision_ms_p50),
            format!("{:.2}", row.served_ms_p50),
            format!("{:.3}", row.overhead_ms_p50),
            format!("{:.2} %", 100.0 * row.overhead_ms_p50 / row.decision_ms_p50),
        ]
    };
    let head = ["wire", "decisions", "kB", "here", "served", "overhead", "share"];
    print_table(&head, rows.iter().map(row));
    println!(
        "Medians in ms, {} candidates, images of {side} x {side} pixels. here: the decision in this process;\n\
         served: from the request to the decoded reply; overhead: the difference of the same decision",
        arguments.candidates
    );
    Ok(())
}
