//! `rever evaluate`: strategies side by side on the same episodes.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use super::episodes::EpisodesArguments;
use runtime::campaign::Report;
use evaluation::result_file::ResultFile;
use decision::Strategy;
use decision::Setting;
use evaluation::suite::{LAYOUTS, Layouts, Suite};
use store::plan::SeedRange;
use evaluation::table;

/// Measures strategies on the same paired episodes; started again it goes on where it was.
#[derive(Debug, Clone, Args)]
pub struct Arguments {
    #[command(flatten)]
    episodes_arguments: EpisodesArguments,
    /// greedy, sample, majority, medoid, verifier, worst, verifier+medoid, oracle; separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "greedy,sample,verifier")]
    strategies: Vec<Strategy>,
    /// Episodes of each task.
    #[arg(long, default_value_t = LAYOUTS)]
    episodes: u32,
    /// The 24 layouts of each task, or random layouts from the held-out range.
    #[arg(long, value_enum, default_value = "grid")]
    layouts: Layouts,
    /// Candidates per step; several, separated by commas, give success against N.
    #[arg(long, value_delimiter = ',', default_value = "5", value_parser = clap::value_parser!(u32).range(1..=256))]
    candidates: Vec<u32>,
    /// Sampling temperature; several may be given, separated by commas.
    #[arg(long, value_delimiter = ',', default_value = "1", value_parser = temperature)]
    temperature: Vec<f32>,
    /// Write the results into this file, too.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// Runs what is missing, then prints the tables.
pub fn run(arguments: Arguments) -> Result<()> {
    let suite = Suite {
        tasks: arguments.episodes_arguments.tasks.clone(),
        episodes: arguments.episodes,
        layouts: arguments.layouts,
        range: SeedRange::Evaluation,
        seed: arguments.episodes_arguments.seed,
    };
    let settings = Setting::all(&arguments.strategies, &arguments.temperature, &arguments.candidates);
    let report = arguments.episodes_arguments.campaign("evaluate", suite, settings)?.run()?;
    show(&report, arguments.json.as_deref())
}

/// Prints the tables of a report and writes its file; an error when the report is partial.
pub fn show(report: &Report, json: Option<&std::path::Path>) -> Result<()> {
    print!("{}", table::text(&report.results));
    println!("records: {}", report.folder.display());
    if let Some(path) = json {
        ResultFile::new(&report.results, report.versions.clone()).write(path)?;
    }
    report.ensure_complete()
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
