//! `rever train`: trains a verifier on collected episodes, prints its held-out metrics and stores them in its file.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use clap::Args;
use evaluation::table::{COLUMNS_DEFAULT, aligned, wrapped};
use runtime::servers::Host;
use runtime::wire::{Network, NetworkOptions, VerifierPublisher};
use serde::Serialize;
use store::run::RunHeader;
use store::write_whole;
use verifier::training::records::{self, CompletionReader, Excluded};
use verifier::training::{EPISODES_MIN, Epoch, TrainingEpisode, TrainingSet, train};
use verifier::{
    Discrimination, Metrics, ReRankingGain, TrainingOptions, Verifier, VerifierDescription,
};

use super::WrongUsage;
use super::names::{self, FLEET_DEFAULT, endpoint, fleet, short};
use super::policy::PolicySource;
use super::recorded_policy::{RecordedPolicy, served_words};

/// How long to wait for an agent that follows the verifier. After that it is published anyway.
const FOLLOWERS_WAIT: Duration = Duration::from_secs(10);

/// Train a verifier on collected episodes
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  rever train                                        on all eligible episodes in runs/labels.sqlite
  rever train runs/collect-1a2b3c4d --out mine.safetensors
  rever train --policy FOLDER --out FOLDER/verifier.safetensors      as the policy's default verifier")]
pub struct Arguments {
    /// Folders of runs to train on; an episode that cannot be used (evaluation layout, strategy other than sample, other policy) is an error [default: the label store]
    runs: Vec<PathBuf>,
    /// Label store to train on; episodes that cannot be used are skipped and counted
    #[arg(long, default_value = "runs/labels.sqlite", conflicts_with = "runs")]
    labels: PathBuf,
    /// File to write the verifier to
    #[arg(long, default_value = "verifier.safetensors", value_parser = super::output_file)]
    out: PathBuf,
    /// Seed of the data split, the initial weights and the sample order
    #[arg(long, default_value_t = TrainingOptions::default().seed)]
    seed: u64,
    /// Maximum number of epochs
    #[arg(long, default_value_t = TrainingOptions::default().epochs_max)]
    epochs: usize,
    /// Sizes of the two hidden layers
    #[arg(long, num_args = 2, value_delimiter = ',', default_values_t = TrainingOptions::default().hidden_sizes)]
    hidden_sizes: Vec<usize>,
    /// Learning rate of the optimizer
    #[arg(long, default_value_t = TrainingOptions::default().learning_rate)]
    learning_rate: f64,
    /// Weight decay of the optimizer
    #[arg(long, default_value_t = TrainingOptions::default().weight_decay)]
    weight_decay: f64,
    /// Share of each task's initial layouts used for validation (early stopping)
    #[arg(long, default_value_t = TrainingOptions::default().validation_share)]
    validation_share: f64,
    /// Share of each task's initial layouts held out for the printed metrics
    #[arg(long, default_value_t = TrainingOptions::default().held_out_share)]
    held_out_share: f64,
    /// Multiplier of the ranking weights for the gripper's distance to its predicted target position; 0 disables them
    #[arg(long, default_value_t = TrainingOptions::default().target_factor)]
    target_factor: f64,
    /// Train the paper's verifier, without the ranking of candidates
    #[arg(long)]
    plain: bool,
    /// Also write the results to this file
    #[arg(long, value_name = "FILE", value_parser = super::output_file)]
    json: Option<PathBuf>,
    /// Publish the verifier under this name to agents that follow it
    #[arg(long, requires = "connect", value_parser = names::verifier)]
    name: Option<String>,
    /// HOST:PORT of the router or agent to publish through
    #[arg(long, requires = "name", value_parser = endpoint)]
    connect: Vec<String>,
    /// Namespace: peers see each other only within the same fleet
    #[arg(long, default_value = FLEET_DEFAULT, value_parser = fleet)]
    fleet: String,
    /// Keep publishing until Ctrl-C, so that agents that start later receive the verifier
    #[arg(long, requires = "name")]
    keep_publishing: bool,
    /// The policy that collected the episodes
    #[command(flatten)]
    policy: PolicySource,
}

/// The file that `--json` writes.
#[derive(Serialize)]
struct ResultFile<'a> {
    /// Digest of the verifier.
    verifier: &'a str,
    /// Where it was written.
    path: &'a Path,
    /// The verifier's description, as stored in its file.
    #[serde(flatten)]
    description: &'a VerifierDescription,
    /// Number of excluded episodes per reason.
    excluded: &'a Excluded,
    /// From the start of the command until the verifier is written.
    wall_secs: f64,
}

/// Trains and writes the verifier, prints its metrics, and publishes it if `--name` is given.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    let started = Instant::now();
    let options = options(&arguments)?;
    options.check().map_err(|error| WrongUsage(error.to_string()))?;
    let header = |folder: &PathBuf| {
        store::run::read_header(folder).map_err(|error| WrongUsage(format!("{error:#}")))
    };
    let headers: Vec<RunHeader> = arguments.runs.iter().map(header).collect::<Result<_, _>>()?;
    let policy = arguments.recorded_policy(&headers, host)?;
    let (episodes, excluded) = policy.with_reader(|reader| read(&arguments, reader))?;
    ensure!(
        !episodes.is_empty(),
        "training: expected eligible episodes, got none; excluded: {}; run `rever collect` first (to train on episodes of \
         a policy server, name its runs)",
        counts(&excluded)
    );
    let action_length = policy.action_space().length();
    let set = TrainingSet::new(policy.hidden_size(), action_length, episodes)?;
    let (count, repeats) = (set.episodes().len(), set.repeats());
    eprintln!("{count} episodes, {repeats} repeats skipped, excluded: {}", counts(&excluded));
    let verifier = train(&set, policy.digest(), &options, |epoch| report(epoch, &options))?;
    write_whole(&arguments.out, verifier.bytes())?;
    print!("{}", table(&verifier));
    let out = arguments.out.display();
    println!("verifier: {out}");
    if let Some(json) = &arguments.json {
        let result = ResultFile {
            verifier: verifier.digest(),
            path: &arguments.out,
            description: verifier.description(),
            excluded: &excluded,
            wall_secs: started.elapsed().as_secs_f64(),
        };
        write_whole(json, &serde_json::to_vec_pretty(&result)?)?;
    }
    let words = match (policy, headers.first()) {
        (RecordedPolicy::Server { .. }, Some(header)) => served_words(header),
        _ => arguments.policy.words(),
    };
    println!("next: rever evaluate{words} --strategies sample,verifier --verifier {out}");
    match &arguments.name {
        Some(name) => publish(&arguments, name, &verifier),
        None => Ok(()),
    }
}

impl Arguments {
    /// The policy of the episodes. A policy server of the named runs needs no checkpoint.
    fn recorded_policy(&self, headers: &[RunHeader], host: &Host) -> Result<RecordedPolicy> {
        if let Some(address) = self.policy.address() {
            return Err(WrongUsage(format!(
                "--policy: expected a checkpoint's folder, got the policy server {address}; to train on its episodes, \
                 name their runs and leave out --policy"
            ))
            .into());
        }
        let server = match self.policy.policy {
            Some(_) => None,
            None => RecordedPolicy::server_of(headers)?,
        };
        let checkpoint = || self.policy.parser(host).map(Arc::new).map(RecordedPolicy::Checkpoint);
        server.map_or_else(checkpoint, Ok)
    }
}

fn read(
    arguments: &Arguments,
    reader: CompletionReader<'_>,
) -> Result<(Vec<TrainingEpisode>, Excluded)> {
    if arguments.runs.is_empty() {
        return records::from_labels(&arguments.labels, reader);
    }
    records::from_runs(&arguments.runs, reader)
}

fn options(arguments: &Arguments) -> Result<TrainingOptions> {
    let hidden_sizes = arguments.hidden_sizes.as_slice().try_into();
    Ok(TrainingOptions {
        seed: arguments.seed,
        hidden_sizes: hidden_sizes.context("hidden sizes: expected two")?,
        epochs_max: arguments.epochs,
        learning_rate: arguments.learning_rate,
        weight_decay: arguments.weight_decay,
        validation_share: arguments.validation_share,
        held_out_share: arguments.held_out_share,
        ranking: !arguments.plain,
        target_factor: arguments.target_factor,
        ..TrainingOptions::default()
    })
}

fn report(epoch: Epoch, options: &TrainingOptions) {
    let Epoch { epoch, training_loss, validation_loss, is_best } = epoch;
    let mark = if is_best { ", best so far" } else { "" };
    let epochs_max = options.epochs_max;
    eprintln!(
        "epoch {epoch} of at most {epochs_max}: training loss {training_loss:.4}, validation loss {validation_loss:.4}{mark}"
    );
}

/// The count of each reason, in one line.
fn counts(excluded: &Excluded) -> String {
    if excluded.is_empty() {
        return "none".to_owned();
    }
    excluded
        .iter()
        .map(|(reason, count)| format!("{count} ({reason})"))
        .collect::<Vec<_>>()
        .join(", ")
}

/// Training data and held-out metrics as text. AUROC per task comes first, because the pooled one is misleading.
pub fn table(verifier: &Verifier) -> String {
    let VerifierDescription { policy, data, held_out, .. } = verifier.description();
    let mut rows = vec![
        ["held-out AUROC", "all steps", "first 10", "middle", "last 10"]
            .map(str::to_owned)
            .to_vec(),
    ];
    let phases = |held_out: &Metrics, value: &dyn Fn(&Discrimination) -> Option<f64>| {
        let Metrics { auroc, auroc_first_steps, auroc_middle_steps, auroc_last_steps, .. } =
            held_out;
        [auroc, auroc_first_steps, auroc_middle_steps, auroc_last_steps]
            .map(|view| figure(value(view)))
    };
    for task in held_out.auroc.tasks.keys() {
        let values = phases(held_out, &|view| view.tasks.get(task).copied().flatten());
        rows.push([&[format!("  {task}")], values.as_slice()].concat());
    }
    let average = phases(held_out, &|view| view.macro_average);
    rows.push([&["  mean of the tasks".to_owned()], average.as_slice()].concat());
    let pooled = phases(held_out, &|view| view.pooled);
    rows.push([&["  pooled".to_owned()], pooled.as_slice()].concat());
    let figures = [
        format!("verifier {} for policy {}\n", short(verifier.digest()), short(policy)),
        ranking_text(verifier),
        format!(
            "fitted to {} episodes ({} successes, {} steps) in {} epochs\n",
            data.training_episodes, data.training_successes, data.training_samples, data.epochs
        ),
        format!(
            "early stopping on {} ({} successes), held out {} ({} successes, {} steps)\n",
            data.validation_episodes,
            data.validation_successes,
            data.held_out_episodes,
            data.held_out_successes,
            data.held_out_samples
        ),
        aligned(&rows),
        "Pooled AUROC also rises if a verifier only separates easy from hard tasks.\n".to_owned(),
        format!(
            "held-out loss {}, Brier score {}, calibration error {} ({} bins)\n",
            figure(held_out.loss),
            figure(held_out.brier_score),
            figure(held_out.calibration_error),
            held_out.reliability.len()
        ),
    ];
    figures.concat()
}

/// The estimated gains of the ranking and of the medoid, from re-ranking single decisions.
fn ranking_text(verifier: &Verifier) -> String {
    let Some(ranking) = &verifier.description().ranking else {
        let text = format!(
            "no ranking of candidates: it needs {EPISODES_MIN} training and validation episodes from `rever collect --candidates 5`, without --plain"
        );
        return wrapped(&text, COLUMNS_DEFAULT);
    };
    let gain = |gain: &ReRankingGain| {
        format!("{:+.1} ± {:.1}", gain.percentage_points, gain.standard_error)
    };
    let text = format!(
        "estimated gain from re-ranking single decisions: {} percentage points; of the medoid: {} (cross-fitted, ± one standard error, {} decisions of {} episodes)",
        gain(&ranking.gain),
        gain(&ranking.medoid_gain),
        ranking.decisions,
        ranking.episodes,
    );
    wrapped(&text, COLUMNS_DEFAULT)
}

fn figure(value: Option<f64>) -> String {
    value.map_or("–".to_owned(), |value| format!("{value:.3}"))
}

fn publish(arguments: &Arguments, name: &str, verifier: &Verifier) -> Result<()> {
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    runtime.block_on(async {
        let options = NetworkOptions {
            connect: arguments.connect.clone(),
            fleet: arguments.fleet.clone(),
            ..NetworkOptions::default()
        };
        let network = Network::open(options).await?;
        let publisher = VerifierPublisher::declare(&network, name).await?;
        let is_followed = publisher.wait_for_follower(FOLLOWERS_WAIT).await?;
        publisher.publish(&verifier.description().policy, verifier.bytes().to_vec()).await?;
        let digest = short(verifier.digest());
        if is_followed {
            println!("published {digest} as {name}");
        } else {
            println!("published {digest} as {name}, but no agent follows it yet");
        }
        if arguments.keep_publishing {
            println!("serving it to agents that start later; press Ctrl-C to stop");
            tokio::signal::ctrl_c().await?;
        }
        drop(publisher);
        network.close().await
    })
}

#[cfg(test)]
mod tests {
    use decision::TaskId;
    use verifier::training::LayoutKey;

    use super::*;

    /// Two tasks, of which only the first has failures.
    fn verifier() -> Verifier {
        let episode = |number: usize| TrainingEpisode {
            name: format!("{number:02}"),
            start: LayoutKey {
                task: TaskId::default_of(if number < 20 { "mixed" } else { "easy" }),
                layout: None,
                seed: number as u64,
            },
            instruction: String::new(),
            is_success: number >= 10,
            hidden: (0..40)
                .map(|step| if number < 10 { step as f32 } else { -1.0 - step as f32 })
                .collect(),
            steps: (0..40).collect(),
            steps_total: 40,
            steps_max: 60,
            decisions: None,
        };
        let set = TrainingSet::new(1, 7, (0..30).map(episode)).expect("a whole set");
        let options = TrainingOptions {
            hidden_sizes: [8, 4],
            epochs_max: 30,
            learning_rate: 1e-2,
            ..TrainingOptions::default()
        };
        train(&set, &"cafe".repeat(16), &options, |_| ()).expect("a verifier")
    }

    #[test]
    fn the_table_names_every_task_and_leaves_open_what_cannot_be_known() {
        let table = table(&verifier());
        let cells = |start: &str| {
            let line = table.lines().find(|line| line.trim_start().starts_with(start));
            line.expect(start)
                .split_whitespace()
                .rev()
                .take(4)
                .map(str::to_owned)
                .collect::<Vec<_>>()
        };
        assert_eq!(cells("easy"), ["–"; 4], "{table}");
        assert_eq!(cells("mixed"), ["1.000"; 4], "{table}");
        assert_eq!(cells("mean of the tasks"), ["1.000"; 4], "{table}");
        assert!(table.contains("for policy cafecafecafe\n"), "{table}");
        let fitted = "fitted to 21 episodes (14 successes, 840 steps) in ";
        let others = "early stopping on 3 (2 successes), held out 6 (4 successes, 240 steps)\n";
        assert!(table.contains(fitted) && table.contains(others), "{table}");
        assert!(table.lines().all(|line| line.chars().count() <= COLUMNS_DEFAULT), "{table}");
    }

    #[test]
    fn exclusions_are_counted_by_reason() {
        assert_eq!(counts(&Excluded::new()), "none");
        let excluded = Excluded::from([("greedy", 3), ("no steps", 1)]);
        assert_eq!(counts(&excluded), "3 (greedy), 1 (no steps)");
    }
}
