//! `rever evaluate`: compares strategies on the same episodes.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use decision::{Setting, Strategy};
use evaluation::result_file::ResultFile;
use evaluation::suite::Layouts;
use runtime::servers::Host;
use store::plan::SeedRange;

use super::Output;
use super::episodes::{EpisodesArguments, Outcome, Request};
use super::names::StrategyParser;

const STRATEGIES_DEFAULT: [Strategy; 3] = [Strategy::Greedy, Strategy::Sample, Strategy::Verifier];

/// Evaluate strategies on the same paired episodes; rerun the same command to resume
#[derive(Debug, Clone, Args)]
#[command(after_help = "Examples:
  rever evaluate                                     greedy, sample and verifier on SIMPLER's 24 layouts of each task
  rever evaluate --tasks stack --strategies sample,verifier --layouts random --episodes 100
  rever evaluate --strategies verifier --candidates 1,2,5,8              success by number of candidates
  rever evaluate --policy FOLDER --strategies greedy,sample              your own checkpoint
  rever evaluate --connect 10.0.0.7:7447                                 on servers on another machine")]
pub struct Arguments {
    /// Strategies, separated by commas [default: greedy,sample,verifier, or greedy,sample if there is no verifier]
    #[arg(long, value_delimiter = ',', value_parser = StrategyParser)]
    strategies: Vec<Strategy>,
    /// Candidates per step; several numbers, separated by commas, compare values of N
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "5", value_parser = clap::value_parser!(u32).range(1..=256))]
    candidates: Vec<u32>,
    /// Sampling temperature; may be several numbers, separated by commas
    #[arg(long, value_name = "T", value_delimiter = ',', default_value = "1", value_parser = temperature)]
    temperature: Vec<f32>,
    /// Episodes per task and setting; 24 cover each of SIMPLER's layouts once
    #[arg(long, default_value_t = 24, allow_negative_numbers = true, value_parser = clap::value_parser!(u32).range(1..))]
    episodes: u32,
    /// Initial layouts: the fixed ones of each task, or random ones from seeds that `collect` never uses
    #[arg(long, value_enum, default_value = "grid")]
    layouts: Layouts,
    #[command(flatten)]
    episodes_arguments: EpisodesArguments,
    /// Also write the results to this file
    #[arg(long, value_name = "FILE", value_parser = super::output_file, help_heading = "Files")]
    json: Option<PathBuf>,
}

/// Runs the missing episodes, then prints the results.
pub fn run(arguments: Arguments, host: &Host, output: Output) -> Result<()> {
    let Arguments { strategies, temperature, candidates, .. } = &arguments;
    let is_default = strategies.is_empty();
    let strategies = if is_default { &STRATEGIES_DEFAULT[..] } else { strategies };
    let settings = Setting::all(strategies, temperature, candidates);
    for setting in settings.iter().filter(|one| one.temperature == 0.0 && one.candidates > 1) {
        eprintln!("{setting}: at temperature 0 all candidates are the same");
    }
    let request = Request {
        title: "evaluate",
        episodes: arguments.episodes,
        layouts: arguments.layouts,
        range: SeedRange::Evaluation,
        settings,
        is_default,
        output,
    };
    let outcome = arguments.episodes_arguments.run(host, request)?;
    show(&outcome, arguments.json.as_deref(), output)?;
    let policy = arguments.episodes_arguments.policy.source.words();
    println!("next: rever report {}{policy}", outcome.folder.display());
    Ok(())
}

/// Prints the results and writes the result file. Returns an error if the run is incomplete.
pub fn show(outcome: &Outcome, json: Option<&Path>, output: Output) -> Result<()> {
    print!("{}", output.results(&outcome.results));
    if let Some(path) = json {
        ResultFile::new(&outcome.results, outcome.provenance.clone())?.write(path)?;
    }
    println!("records: {}", outcome.folder.display());
    outcome.ending.ensure_complete(&outcome.folder)
}

/// Parses a sampling temperature.
pub fn temperature(text: &str) -> Result<f32, String> {
    let temperature: f32 =
        text.trim().parse().map_err(|_| format!("expected a number, got {text:?}"))?;
    if temperature.is_finite() && temperature >= 0.0 {
        Ok(temperature)
    } else {
        Err(format!("expected a finite number of at least 0, got {text}"))
    }
}
