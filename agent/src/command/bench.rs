//! `rever bench`: what the parts of the program cost on this machine.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::{Args, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};

use super::episodes::policy_folder;
use crate::bench::{DecisionBench, Report, Torch, read_observations};
use crate::policy::Policy;
use crate::setup;
use crate::verifier::Verifier;

/// What the parts of the program cost on this machine.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(subcommand)]
    part: Part,
}

#[derive(Debug, Subcommand)]
enum Part {
    Decision(DecisionArguments),
}

/// One decision at a time on recorded observations: prefill, decode, parse, score, choose
#[derive(Debug, Args)]
struct DecisionArguments {
    /// The checkpoint's folder [default: the one that comes with rever]
    #[arg(long)]
    policy: Option<PathBuf>,
    /// The verifier's file [default: the one beside the policy's weights]
    #[arg(long)]
    verifier: Option<PathBuf>,
    /// Recorded observations: images and instructions [default: eight of the shipped policy's size]
    #[arg(long, value_name = "FILE")]
    observations: Option<PathBuf>,
    /// Passes over all observations
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Make the same decisions in PyTorch, in turns
    #[arg(long)]
    compare: bool,
    /// A Python that has PyTorch, for --compare
    #[arg(long, value_name = "FILE", default_value = "python3")]
    python: PathBuf,
    /// Write the figures into this file, too
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Times what was asked for and prints a table.
pub fn run(arguments: Arguments) -> Result<()> {
    let Part::Decision(arguments) = arguments.part;
    let folder = policy_folder(arguments.policy.as_ref())?;
    let file = arguments.verifier.unwrap_or_else(|| folder.join("verifier.safetensors"));
    let policy = Policy::load(&folder)?;
    let verifier = Verifier::load(&file, policy.digest())?;
    let recorded = match arguments.observations {
        Some(file) => file,
        None => setup::repository()?.join("agent/tests/fixtures/bridge-small.safetensors"),
    };
    let observations = read_observations(&recorded)?;
    let torch = if arguments.compare {
        let script = setup::repository()?.join("agent/training/bench.py");
        Some(Torch::start(&arguments.python, &script, &folder, &recorded)?)
    } else {
        None
    };
    let progress = ProgressBar::new(u64::from(arguments.rounds) + 1);
    let style = "bench: {pos}/{len} rounds, {eta} left";
    progress.set_style(ProgressStyle::with_template(style).context("progress line")?);
    let bench = DecisionBench {
        policy: &policy,
        verifier: &verifier,
        observations: &observations,
        rounds: arguments.rounds as usize,
    };
    let report = bench.run(torch, |round| progress.set_position(round as u64))?;
    progress.finish_and_clear();
    if let Some(path) = &arguments.json {
        let text = serde_json::to_string_pretty(&report)?;
        std::fs::write(path, text + "\n")
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    print(&report);
    Ok(())
}

fn print(report: &Report) {
    println!(
        "{:>10} {:>5} {:>10} {:>8} {:>7} {:>9} {:>9} {:>9} {:>10}",
        "candidates",
        "T",
        "prefill ms",
        "step ms",
        "tokens",
        "p50 ms",
        "p95 ms",
        "tokens/s",
        "bandwidth"
    );
    for row in &report.rows {
        println!(
            "{:>10} {:>5} {:>10.2} {:>8.3} {:>7.1} {:>9.1} {:>9.1} {:>9.0} {:>8.0} %",
            row.setting.candidates,
            row.setting.temperature,
            row.prefill_ms,
            row.step_ms,
            row.tokens,
            row.decision_ms_p50,
            row.decision_ms_p95,
            row.tokens_per_second,
            100.0 * row.bandwidth_share,
        );
    }
    let megabytes = report.rows.first().map_or(0.0, |row| row.weight_bytes as f64 / 1e6);
    println!(
        "{} decisions each, {} threads; a step reads {megabytes:.1} MB of weights, this machine reads as much at {:.1} GB/s",
        report.decisions,
        report.threads,
        report.bandwidth_bytes_per_second / 1e9,
    );
    for one in &report.torch {
        println!(
            "PyTorch {:<10} {:>3} candidates: {:>8.1} ms (p50) {:>8.1} ms (p95)",
            one.setting, one.candidates, one.decision_ms_p50, one.decision_ms_p95
        );
    }
    for why in report.torch_hello.iter().flat_map(|hello| &hello.broken) {
        println!("PyTorch: {why}");
    }
    println!(
        "ratio_greedy {:.2} (five verified candidates over one greedy one)",
        report.ratio_greedy
    );
    if let (Some(eager), Some(best)) = (report.ratio_eager, report.ratio_best) {
        println!(
            "ratio_eager {eager:.2}, ratio_best {best:.2} (PyTorch over rever, five candidates)"
        );
    }
}
