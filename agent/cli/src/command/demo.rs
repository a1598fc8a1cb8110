//! `rever demo`: the whole loop on this machine within minutes, ending with a page to look at.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use decision::{Setting, Strategy};
use evaluation::result_file::ResultFile;
use evaluation::suite::Layouts;
use evaluation::table;
use runtime::servers::Host;
use store::plan::SeedRange;

use super::episodes::{EpisodesArguments, Request};
use super::report;

/// Environment servers: one per core of a small machine.
const SERVERS: u16 = 2;

/// What the verifier chooses from, as in the results.
const CANDIDATES: u32 = 5;
const TEMPERATURE: f32 = 1.0;

/// Run every task with a single sample and with the verifier's choice, then build a report with videos.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Random layouts of each task; each is run with a single sample and with the verifier
    #[arg(long, default_value_t = 6)]
    episodes: u32,
    /// Another number gives other layouts
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// The run's folder; the same command resumes it [default: runs/demo-…]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Also write the figures to this file, in the form of `rever evaluate`
    #[arg(long, value_name = "FILE", value_parser = super::output_file)]
    json: Option<PathBuf>,
    /// A Python that has the packages already, instead of the one that is set up
    #[arg(long)]
    python: Option<PathBuf>,
}

/// Runs the demonstration, prints its tables and where its page is.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    let started = Instant::now();
    println!(
        "{} random layouts of each task, each with a single sample and with the verifier's choice of {CANDIDATES}",
        arguments.episodes
    );
    let setting = |strategy| Setting::new(strategy, CANDIDATES, TEMPERATURE);
    let episodes = EpisodesArguments {
        seed: arguments.seed,
        servers: Some(SERVERS),
        fleet: "demo".to_owned(),
        out: arguments.out,
        video: true,
        python: arguments.python,
        ..EpisodesArguments::default()
    };
    let outcome = episodes.run(
        host,
        Request {
            title: "demo",
            episodes: arguments.episodes,
            layouts: Layouts::Random,
            range: SeedRange::Evaluation,
            settings: vec![setting(Strategy::Sample), setting(Strategy::Verifier)],
        },
    )?;
    let out = outcome.folder.join("report");
    let page = report::build(&outcome.folder, &out, &outcome.policy, report::EPISODES_MAX)?;
    println!("\n{}", table::text(&outcome.results));
    println!("{}", report::describe(&page));
    println!("done in {:.0} s", started.elapsed().as_secs_f64());
    if let Some(path) = &arguments.json {
        ResultFile::new(&outcome.results, outcome.provenance.clone())?.write(path)?;
    }
    outcome.ending.ensure_complete(&outcome.folder)
}
