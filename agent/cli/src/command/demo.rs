//! `rever demo`: runs the whole loop on this machine within minutes and builds a report page.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use decision::{Setting, Strategy};
use evaluation::result_file::ResultFile;
use evaluation::suite::Layouts;
use runtime::servers::Host;
use store::plan::SeedRange;

use super::episodes::{EpisodesArguments, Request};
use super::policy::{PolicyArguments, verifier_beside};
use super::{Output, report};

/// Environment server processes: one per core of a small machine.
const SERVERS: u16 = 2;

/// Candidates per step that the verifier chooses among, as in the published results.
const CANDIDATES: u32 = 5;
const TEMPERATURE: f32 = 1.0;

/// Compare a single sample with the verifier's choice on all tasks, then build a page with videos; without a verifier,
/// with the medoid of five
#[derive(Debug, Args)]
pub struct Arguments {
    /// Random initial layouts per task; each is run with a single sample and with the verifier
    #[arg(long, default_value_t = 6, allow_negative_numbers = true, value_parser = clap::value_parser!(u32).range(1..))]
    episodes: u32,
    /// Random seed of initial layouts and samples
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder of the run; rerun the same command to resume it [default: a folder under runs/]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Also write the results to this file
    #[arg(long, value_name = "FILE", value_parser = super::output_file)]
    json: Option<PathBuf>,
    /// Python interpreter for the servers, which must have env-server's packages [default: an environment that rever sets up]
    #[arg(long)]
    python: Option<PathBuf>,
    #[command(flatten)]
    policy: PolicyArguments,
}

/// Runs the demonstration, then prints its results and the path of its page.
pub fn run(arguments: Arguments, host: &Host, output: Output) -> Result<()> {
    let started = Instant::now();
    let has_verifier = match arguments.policy.source.address() {
        Some(_) => false,
        None => verifier_beside(&arguments.policy.source.folder(host)?).is_some(),
    };
    let (compared, name) = match has_verifier {
        true => (Strategy::Verifier, "the verifier"),
        false => (Strategy::Medoid, "the medoid, because the policy has no verifier"),
    };
    println!(
        "{} random initial layouts per task, each run with a single sample and with {name} (N = {CANDIDATES})",
        arguments.episodes
    );
    let setting = |strategy| Setting::new(strategy, CANDIDATES, TEMPERATURE);
    let episodes = EpisodesArguments {
        seed: arguments.seed,
        policy: arguments.policy.clone(),
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
            settings: vec![setting(Strategy::Sample), setting(compared)],
            is_default: false,
            output,
        },
    )?;
    let out = outcome.folder.join("report");
    let page =
        report::build(&outcome.folder, &out, &arguments.policy.source, report::EPISODES_MAX, host)?;
    println!("\n{}", output.results(&outcome.results));
    println!("{}", report::describe(&page));
    println!("done in {:.0} s", started.elapsed().as_secs_f64());
    if let Some(path) = &arguments.json {
        ResultFile::new(&outcome.results, outcome.provenance.clone())?.write(path)?;
    }
    outcome.ending.ensure_complete(&outcome.folder)?;
    match arguments.policy.words().as_str() {
        "" => println!(
            "next: open the page, or evaluate your own checkpoint: rever evaluate --policy FOLDER"
        ),
        policy => println!("next: open the page, or: rever evaluate{policy}"),
    }
    Ok(())
}
