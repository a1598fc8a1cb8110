//! `rever collect`: sampled episodes with their outcomes, for the verifier to learn from.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use super::episodes::EpisodesArguments;
use super::evaluate::{show, temperature};
use decision::Strategy;
use decision::Setting;
use evaluation::suite::{Layouts, Suite};
use store::plan::SeedRange;

/// Runs sampled episodes on random layouts that evaluation never sees, and keeps them as labels.
#[derive(Debug, Clone, Args)]
pub struct Arguments {
    #[command(flatten)]
    episodes_arguments: EpisodesArguments,
    /// How candidates are chosen; `sample` executes the first, and the others show what it was drawn beside.
    #[arg(long, default_value = "sample")]
    strategy: Strategy,
    /// Episodes of each task.
    #[arg(long, default_value_t = 100)]
    episodes: u32,
    /// Candidates per step; with one, a verifier cannot learn to choose.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=256))]
    candidates: u32,
    /// Sampling temperature.
    #[arg(long, default_value_t = 1.0, value_parser = temperature)]
    temperature: f32,
    /// Write the results into this file, too.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Runs what is missing, then prints how many episodes succeeded.
pub fn run(arguments: Arguments) -> Result<()> {
    let suite = Suite {
        tasks: arguments.episodes_arguments.tasks.clone(),
        episodes: arguments.episodes,
        layouts: Layouts::Random,
        range: SeedRange::Collection,
        seed: arguments.episodes_arguments.seed,
    };
    let Arguments { strategy, candidates, temperature, .. } = arguments;
    let setting = match strategy {
        // In an evaluation the siblings of a sample would be a waste of time; here they teach.
        Strategy::Sample => Setting { strategy, candidates, temperature },
        _ => Setting::new(strategy, candidates, temperature),
    };
    let mut episodes_arguments = arguments.episodes_arguments;
    episodes_arguments.all_hidden |= strategy == Strategy::Sample;
    let campaign = episodes_arguments.campaign("collect", suite, vec![setting])?;
    let report = campaign.run()?;
    println!("labels: {}", campaign.labels.display());
    show(&report, arguments.json.as_deref())
}
