//! `rever bench decision`: the arguments and the table of the benchmark of single decisions.

use std::path::PathBuf;

use anyhow::{Context, Result, ensure};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use runtime::servers::Host;
use vla::DeviceName;

use super::{print_table, write_json};
use crate::bench::{self, DecisionBench, Report, Torch, read_observations, scaled};
use crate::command::output_file;
use crate::command::policy::PolicyArguments;
use crate::files;

/// Measure one decision at a time on recorded observations: prefill, decode, parse, score, choose
#[derive(Debug, Args)]
pub struct Arguments {
    /// File of the verifier [default: verifier.safetensors in the policy's folder, if it exists]
    #[arg(long, value_name = "FILE", help_heading = "Policy and verifier")]
    verifier: Option<PathBuf>,
    /// File of recorded observations: images and instructions [default: eight built-in ones, scaled to the policy's image size]
    #[arg(long, value_name = "FILE")]
    observations: Option<PathBuf>,
    /// Number of passes over all observations
    #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Also time the same decisions in PyTorch, alternating with rever
    #[arg(long)]
    compare: bool,
    /// Python with PyTorch, for --compare
    #[arg(long, value_name = "FILE", default_value = "python3")]
    python: PathBuf,
    /// Also write the figures to this file
    #[arg(long, value_name = "FILE", value_parser = output_file)]
    json: Option<PathBuf>,
    #[command(flatten)]
    policy: PolicyArguments,
}

/// Runs the benchmark and prints its table.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    ensure!(
        !arguments.compare || arguments.policy.device == DeviceName::Cpu,
        "--compare: expected --device cpu, because PyTorch runs on the CPU, got {}",
        arguments.policy.device
    );
    let loaded = arguments.policy.load(host)?;
    let verifier = loaded.verifier(arguments.verifier)?;
    let recorded = match arguments.observations {
        Some(file) => file,
        None => files::of_checkout(host, "agent/vla/tests/fixtures/bridge-small.safetensors")?,
    };
    let size = loaded.policy.info().image_size;
    let observations = read_observations(&recorded)?;
    let fits = observations.iter().all(|one| (one.image.height, one.image.width) == size);
    ensure!(
        fits || !arguments.compare,
        "--compare: expected --observations of {} x {} pixels, because PyTorch reads the same file",
        size.0,
        size.1
    );
    let observations = scaled(observations, size);
    let torch = if arguments.compare {
        let script = files::of_checkout(host, "agent/training/bench.py")?;
        let missing = || format!("--compare: expected a local checkpoint, got {}", loaded.name);
        let folder = loaded.folder.as_ref().with_context(missing)?;
        Some(Torch::start(&arguments.python, &script, folder, &recorded)?)
    } else {
        None
    };
    let progress = ProgressBar::new(u64::from(arguments.rounds) + 1);
    let style = "bench: {pos}/{len} rounds, {eta} left";
    progress.set_style(ProgressStyle::with_template(style).context("progress line")?);
    let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
    let bench = DecisionBench {
        policy: loaded.policy,
        checkpoint: loaded.checkpoint,
        verifier,
        observations: &observations,
        rounds: arguments.rounds as usize,
        runtime: &runtime,
    };
    let report = bench.run(torch, |round| progress.set_position(round as u64))?;
    progress.finish_and_clear();
    if let Some(path) = &arguments.json {
        write_json(path, serde_json::to_value(&report)?)?;
    }
    print(&report);
    Ok(())
}

fn print(report: &Report) {
    let row = |row: &bench::DecisionRow| {
        let of_network = |cell: &dyn Fn(&bench::NetworkRow) -> String| {
            row.network.as_ref().map_or_else(|| "-".to_owned(), cell)
        };
        vec![
            row.setting.candidates.to_string(),
            row.setting.temperature.to_string(),
            of_network(&|network| format!("{:.2}", network.prefill_ms)),
            of_network(&|network| format!("{:.3}", network.step_ms)),
            format!("{:.1}", row.tokens),
            format!("{:.1}", row.decision_ms_p50),
            format!("{:.1}", row.decision_ms_p95),
            format!("{:.0}", row.tokens_per_second),
            of_network(&|network| format!("{:.0} %", 100.0 * network.bandwidth_share)),
        ]
    };
    let head =
        ["N", "T", "prefill ms", "step ms", "tokens", "p50 ms", "p95 ms", "tokens/s", "bandwidth"];
    print_table(&head, report.rows.iter().map(row));
    println!(
        "{} decisions per row, {} threads; strategy {} (greedy where T is 0)",
        report.decisions, report.threads, report.strategy
    );
    let network = report.rows.first().and_then(|row| row.network.as_ref());
    if let (Some(network), Some(bandwidth)) = (network, report.bandwidth_bytes_per_second) {
        let (megabytes, gigabytes) = (network.weight_bytes as f64 / 1e6, bandwidth / 1e9);
        println!(
            "A token step reads {megabytes:.1} MB of weights; this machine reads a buffer of that size, or of 1 GiB, at {gigabytes:.1} GB/s."
        );
    }
    for one in &report.torch {
        println!(
            "PyTorch {:<10} {:>3} candidates: {:>8.1} ms (p50) {:>8.1} ms (p95)",
            one.setting, one.candidates, one.decision_ms_p50, one.decision_ms_p95
        );
    }
    for reason in report.torch_hello.iter().flat_map(|hello| &hello.broken) {
        println!("PyTorch: {reason}");
    }
    if let Some(ratio) = report.ratio_greedy {
        println!(
            "ratio_greedy {ratio:.2} (time of five compared candidates / time of one greedy candidate)"
        );
    }
    if let (Some(eager), Some(best)) = (report.ratio_eager, report.ratio_best) {
        println!(
            "ratio_eager {eager:.2}, ratio_best {best:.2} (time of PyTorch / time of rever, five candidates)"
        );
    }
}
