//! `rever collect`: sampled episodes with their outcomes, for the verifier to learn from.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use decision::{Setting, Strategy};
use evaluation::suite::Layouts;
use runtime::servers::Host;
use store::plan::SeedRange;

use super::episodes::{EpisodesArguments, Request};
use super::evaluate::{show, temperature};

/// Collect sampled episodes as labels, on random layouts that evaluation never sees.
#[derive(Debug, Clone, Args)]
pub struct Arguments {
    #[command(flatten)]
    episodes_arguments: EpisodesArguments,
    /// How candidates are chosen; `sample` executes the first and records the others beside it.
    #[arg(long, default_value = "sample")]
    strategy: Strategy,
    /// Episodes of each task.
    #[arg(long, default_value_t = 100)]
    episodes: u32,
    /// Candidates per step; with one, no verifier can be trained to choose.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=256))]
    candidates: u32,
    /// Sampling temperature.
    #[arg(long, default_value_t = 1.0, value_parser = temperature)]
    temperature: f32,
    /// Write the results to this file, too.
    #[arg(long, value_name = "FILE", value_parser = super::output_file)]
    json: Option<PathBuf>,
}

/// Runs what is missing, then prints how many episodes succeeded.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    let Arguments { strategy, candidates, temperature, .. } = arguments;
    let setting = match strategy {
        // In an evaluation the candidates beside a sample would be a waste of time; here a verifier is trained on them.
        Strategy::Sample => Setting { strategy, candidates, temperature },
        _ => Setting::new(strategy, candidates, temperature),
    };
    let mut episodes_arguments = arguments.episodes_arguments;
    episodes_arguments.all_hidden |= strategy == Strategy::Sample;
    let outcome = episodes_arguments.run(
        host,
        Request {
            title: "collect",
            episodes: arguments.episodes,
            layouts: Layouts::Random,
            range: SeedRange::Collection,
            settings: vec![setting],
        },
    )?;
    println!("labels: {}", episodes_arguments.labels.display());
    show(&outcome, arguments.json.as_deref())
}
