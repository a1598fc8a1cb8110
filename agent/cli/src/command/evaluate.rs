//! `rever evaluate`: strategies side by side on the same episodes.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use decision::{Setting, Strategy};
use evaluation::result_file::ResultFile;
use evaluation::suite::Layouts;
use evaluation::table;
use runtime::servers::Host;
use store::plan::SeedRange;

use super::episodes::{EpisodesArguments, Outcome, Request};

/// Evaluate strategies on the same paired episodes; the same command resumes.
#[derive(Debug, Clone, Args)]
pub struct Arguments {
    #[command(flatten)]
    episodes_arguments: EpisodesArguments,
    /// greedy, sample, first-well-formed, majority, medoid, verifier, worst, verifier+medoid, oracle; separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "greedy,sample,verifier")]
    strategies: Vec<Strategy>,
    /// Episodes of each task; with 24, each of SIMPLER's layouts once.
    #[arg(long, default_value_t = 24)]
    episodes: u32,
    /// Each task's fixed initial layouts, over and over, or random ones from the held-out range.
    #[arg(long, value_enum, default_value = "grid")]
    layouts: Layouts,
    /// Candidates per step; several, separated by commas, give success against N.
    #[arg(long, value_delimiter = ',', default_value = "5", value_parser = clap::value_parser!(u32).range(1..=256))]
    candidates: Vec<u32>,
    /// Sampling temperature; several may be given, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "1", value_parser = temperature)]
    temperature: Vec<f32>,
    /// Write the results to this file, too.
    #[arg(long, value_name = "FILE", value_parser = super::output_file)]
    json: Option<PathBuf>,
}

/// Runs what is missing, then prints the tables.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    let Arguments { strategies, temperature, candidates, .. } = &arguments;
    let request = Request {
        title: "evaluate",
        episodes: arguments.episodes,
        layouts: arguments.layouts,
        range: SeedRange::Evaluation,
        settings: Setting::all(strategies, temperature, candidates),
    };
    let outcome = arguments.episodes_arguments.run(host, request)?;
    show(&outcome, arguments.json.as_deref())
}

/// Prints the tables of an outcome and writes its file; an error when it is partial.
pub fn show(outcome: &Outcome, json: Option<&Path>) -> Result<()> {
    print!("{}", table::text(&outcome.results));
    println!("records: {}", outcome.folder.display());
    if let Some(path) = json {
        ResultFile::new(&outcome.results, outcome.provenance.clone())?.write(path)?;
    }
    outcome.ending.ensure_complete(&outcome.folder)
}

/// A temperature that can be sampled at.
pub fn temperature(text: &str) -> Result<f32, String> {
    let temperature: f32 = text.parse().map_err(|_| format!("expected a number, got {text:?}"))?;
    if temperature.is_finite() && temperature >= 0.0 {
        Ok(temperature)
    } else {
        Err(format!("expected 0 or more, got {text}"))
    }
}
