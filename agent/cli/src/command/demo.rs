//! `rever demo`: the whole loop on this machine within minutes, ending with a page to look at.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::Args;

use super::episodes::policy_folder;
use super::report;
use runtime::campaign::Campaign;
use vla::DeviceName;
use evaluation::result_file::ResultFile;
use runtime::rollout::Keep;
use runtime::site::Site;
use decision::Strategy;
use decision::Setting;
use evaluation::suite::{Layouts, Suite, TASKS};
use store::plan::SeedRange;
use evaluation::table;

/// Environment servers: one per core of a small machine.
const SERVERS: usize = 2;

/// Episodes at once: enough that the policy's matrix products are worth their weights' way from memory.
const SESSIONS: usize = 16;

/// What the verifier chooses from, as in the results.
const CANDIDATES: u32 = 5;
const TEMPERATURE: f32 = 1.0;

/// Runs the four tasks with one sample and with the verifier's choice, then builds a report with videos.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Random layouts of each task; each is run with one sample and with the verifier
    #[arg(long, default_value_t = 6)]
    episodes: u32,
    /// Another number gives other layouts
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// The run's folder; the same command goes on where it was [default: runs/demo-…]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Also write the figures to this file, in the form of `rever evaluate`
    #[arg(long)]
    json: Option<PathBuf>,
    /// A Python that has the packages already, instead of the one that is set up
    #[arg(long)]
    python: Option<PathBuf>,
}

/// Runs the demonstration, prints its tables and where its page is.
pub fn run(arguments: Arguments) -> Result<()> {
    let started = Instant::now();
    let campaign = campaign(&arguments)?;
    println!(
        "{} layouts of {} tasks, each with one sample and with the verifier's choice of {CANDIDATES}",
        arguments.episodes,
        TASKS.len()
    );
    let outcome = campaign.run()?;
    let out = outcome.folder.join("report");
    let page = report::build(&outcome.folder, &out, &campaign.policy, report::EPISODES_MAX)?;
    println!("\n{}", table::text(&outcome.results));
    println!("{}", report::describe(&page));
    println!("done in {:.0} s", started.elapsed().as_secs_f64());
    if let Some(path) = &arguments.json {
        ResultFile::new(&outcome.results, outcome.versions.clone()).write(path)?;
    }
    outcome.ensure_complete()
}

fn campaign(arguments: &Arguments) -> Result<Campaign> {
    let policy = policy_folder(None)?;
    let setting = |strategy| Setting::new(strategy, CANDIDATES, TEMPERATURE);
    Ok(Campaign {
        title: "demo".to_owned(),
        suite: Suite {
            tasks: TASKS.map(str::to_owned).to_vec(),
            episodes: arguments.episodes,
            layouts: Layouts::Random,
            range: SeedRange::Evaluation,
            seed: arguments.seed,
        },
        settings: vec![setting(Strategy::Sample), setting(Strategy::Verifier)],
        verifier: Some(policy.join("verifier.safetensors")),
        policy,
        device: DeviceName::Cpu,
        follow_verifier: None,
        site: Site {
            servers: SERVERS,
            fleet: "demo".to_owned(),
            python: arguments.python.clone(),
            ..Site::default()
        },
        sessions: SESSIONS,
        out: arguments.out.clone(),
        labels: PathBuf::from("runs/labels.sqlite"),
        keep: Keep { all_hidden: false, video: true },
    })
}
