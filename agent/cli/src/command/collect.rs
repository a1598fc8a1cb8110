//! `rever collect`: records sampled episodes and their outcomes as training data for a verifier.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use decision::{Setting, Strategy};
use evaluation::suite::Layouts;
use runtime::servers::Host;
use store::plan::SeedRange;

use super::Output;
use super::episodes::{EpisodesArguments, Request};
use super::evaluate::{show, temperature};
use super::names::StrategyParser;

/// Collect labelled episodes for training, on random initial layouts that evaluation never uses
#[derive(Debug, Clone, Args)]
#[command(after_help = "Examples:
  rever collect --episodes 200                       800 labelled episodes of the four tasks, then: rever train
  rever collect --policy FOLDER --episodes 300       to train a verifier for your own checkpoint")]
pub struct Arguments {
    /// Strategy that chooses the executed candidate; `sample` executes the first and records the others
    #[arg(long, default_value = "sample", value_parser = StrategyParser)]
    strategy: Strategy,
    /// Candidates per step; a verifier learns to rank candidates only from two or more
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=256))]
    candidates: u32,
    /// Sampling temperature
    #[arg(long, value_name = "T", default_value_t = 1.0, value_parser = temperature)]
    temperature: f32,
    /// Episodes per task
    #[arg(long, default_value_t = 100, allow_negative_numbers = true, value_parser = clap::value_parser!(u32).range(1..))]
    episodes: u32,
    #[command(flatten)]
    episodes_arguments: EpisodesArguments,
    /// Also write the results to this file
    #[arg(long, value_name = "FILE", value_parser = super::output_file, help_heading = "Files")]
    json: Option<PathBuf>,
}

/// Runs the missing episodes, then prints the success rates.
pub fn run(arguments: Arguments, host: &Host, output: Output) -> Result<()> {
    let Arguments { strategy, candidates, temperature, .. } = arguments;
    let setting = match strategy {
        // `Setting::new` reduces `sample` to one candidate, but a verifier is trained on all of them.
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
            is_default: false,
            output,
        },
    )?;
    println!("labels: {}", episodes_arguments.labels.display());
    show(&outcome, arguments.json.as_deref(), output)?;
    let (policy, folder) = (&episodes_arguments.policy.source, outcome.folder.display());
    match policy.address() {
        None => println!("next: rever train {folder}{}", policy.words()),
        Some(_) if outcome.provenance["served"]["hidden_size"].is_u64() => {
            println!("next: rever train {folder}");
        }
        // Without hidden states there is nothing to train on.
        Some(_) => println!("next: rever report {folder}"),
    }
    Ok(())
}
