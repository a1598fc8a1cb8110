//! `rever train`: finished episodes become a verifier, with its held-out quality printed and kept in the file.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use clap::Args;
use serde::Serialize;

use super::episodes::policy_folder;
use vla::{DeviceName, Vla};
use store::record::write_whole;
use evaluation::table::aligned;
use crate::training::records::{self, Reader};
use verifier::training::{Epoch, LabelledEpisode, TrainingSet, train};
use verifier::{Description, Discrimination, Gain, Metrics, Options, Verifier, Words};
use runtime::wire::{Network, NetworkOptions, VerifierPublisher};

/// How long to look for agents that follow the verifier before it is published to nobody yet.
const FOLLOWERS_WAIT: Duration = Duration::from_secs(10);

/// Train a verifier on finished episodes.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Runs to learn from; every episode in them must be fit for it. Without any, the label store is used
    runs: Vec<PathBuf>,
    /// Label store to learn from; what is not fit to teach is set aside and counted
    #[arg(long, default_value = "runs/labels.sqlite", conflicts_with = "runs")]
    labels: PathBuf,
    /// Folder of the policy whose hidden states the records hold, instead of the one that comes with the program
    #[arg(long, value_name = "FOLDER")]
    policy: Option<PathBuf>,
    /// Where to write the verifier
    #[arg(long, default_value = "verifier.safetensors")]
    out: PathBuf,
    /// Seed of the split, the first weights and the order of samples
    #[arg(long, default_value_t = Options::default().seed)]
    seed: u64,
    /// Passes over the samples at most
    #[arg(long, default_value_t = Options::default().epochs_max)]
    epochs: usize,
    /// Sizes of the two hidden layers
    #[arg(long, num_args = 2, value_delimiter = ',', default_values_t = Options::default().hidden_sizes)]
    hidden_sizes: Vec<usize>,
    /// Step size of the optimiser
    #[arg(long, default_value_t = Options::default().learning_rate)]
    learning_rate: f64,
    /// Weight decay of the optimiser
    #[arg(long, default_value_t = Options::default().weight_decay)]
    weight_decay: f64,
    /// Share of the episodes of every task that is held out
    #[arg(long, default_value_t = Options::default().held_out_share)]
    held_out_share: f64,
    /// What the weights of the nearness to the target are multiplied by; 0 leaves the target out
    #[arg(long, default_value_t = Options::default().aim_factor)]
    aim_factor: f64,
    /// Leave out the part that compares candidates: the paper's verifier
    #[arg(long)]
    plain: bool,
    /// Also write the figures to this file
    #[arg(long)]
    json: Option<PathBuf>,
    /// Publish the verifier under this name to agents that follow it
    #[arg(long, requires = "connect")]
    name: Option<String>,
    /// Router or agent to publish through, as tcp/host:port
    #[arg(long, requires = "name")]
    connect: Vec<String>,
    /// Who meets whom
    #[arg(long, default_value = "local")]
    fleet: String,
    /// After publishing, stay until Ctrl-C so that agents that start later get the verifier too
    #[arg(long, requires = "name")]
    keep_publishing: bool,
}

/// The file that `--json` writes.
#[derive(Serialize)]
struct ResultFile<'a> {
    /// Digest of the verifier.
    verifier: &'a str,
    /// Where it was written.
    path: &'a Path,
    /// Everything that the verifier says about itself.
    #[serde(flatten)]
    description: &'a Description,
    /// Episodes that were not used, by reason.
    set_aside: &'a BTreeMap<&'static str, usize>,
    /// From the first record read to the file written.
    wall_secs: f64,
}

/// Trains, prints, writes, publishes.
pub fn run(arguments: Arguments) -> Result<()> {
    let started = Instant::now();
    let policy = policy_folder(arguments.policy.as_ref())?;
    let policy = Policy::load(&policy, DeviceName::Cpu)?;
    let action_scale = policy.action_scale();
    let confidence =
        |tokens: &[u32], log_probabilities: &[f32]| policy.confidence(tokens, log_probabilities);
    let words = |tokens: &[u32]| Words::of(&policy.parse(tokens).ok()?.reasoning);
    let reader = Reader {
        policy: policy.digest(),
        action_scale: &action_scale,
        confidence: &confidence,
        words: &words,
    };
    let (episodes, set_aside) = read(&arguments, reader)?;
    ensure!(
        !episodes.is_empty(),
        "training: expected episodes, got none; set aside: {}",
        counts(&set_aside)
    );
    let set = TrainingSet::new(policy.hidden_size(), episodes)?;
    eprintln!("{} episodes, {} set aside", set.episodes().len(), counts(&set_aside));
    let options = options(&arguments)?;
    let verifier = train(&set, policy.digest(), &options, |epoch| say(epoch, &options))?;
    // A bare file name has no folder to write the temporary file into.
    let path = Path::new(".").join(&arguments.out);
    write_whole(&path, verifier.bytes())?;
    print!("{}", table(&verifier));
    println!("written to {}", arguments.out.display());
    if let Some(json) = &arguments.json {
        let result = ResultFile {
            verifier: verifier.digest(),
            path: &arguments.out,
            description: verifier.description(),
            set_aside: &set_aside,
            wall_secs: started.elapsed().as_secs_f64(),
        };
        write_whole(&Path::new(".").join(json), &serde_json::to_vec_pretty(&result)?)?;
    }
    match &arguments.name {
        Some(name) => publish(&arguments, name, &verifier),
        None => Ok(()),
    }
}

fn read(
    arguments: &Arguments,
    reader: Reader<'_>,
) -> Result<(Vec<LabelledEpisode>, BTreeMap<&'static str, usize>)> {
    if arguments.runs.is_empty() {
        return records::from_labels(&arguments.labels, reader);
    }
    Ok((records::from_runs(&arguments.runs, reader)?, BTreeMap::new()))
}

fn options(arguments: &Arguments) -> Result<Options> {
    let hidden_sizes = arguments.hidden_sizes.as_slice().try_into();
    Ok(Options {
        seed: arguments.seed,
        hidden_sizes: hidden_sizes.context("hidden sizes: expected two")?,
        epochs_max: arguments.epochs,
        learning_rate: arguments.learning_rate,
        weight_decay: arguments.weight_decay,
        held_out_share: arguments.held_out_share,
        choice: !arguments.plain,
        aim_factor: arguments.aim_factor,
        ..Options::default()
    })
}

fn say(epoch: Epoch, options: &Options) {
    let Epoch { epoch, training_loss, held_out_loss, is_best } = epoch;
    let mark = if is_best { ", best so far" } else { "" };
    let epochs_max = options.epochs_max;
    eprintln!(
        "pass {epoch} of at most {epochs_max}: loss {training_loss:.4}, held out {held_out_loss:.4}{mark}"
    );
}

/// Reasons and their numbers in one line.
fn counts(set_aside: &BTreeMap<&'static str, usize>) -> String {
    if set_aside.is_empty() {
        return "none".to_owned();
    }
    set_aside
        .iter()
        .map(|(reason, count)| format!("{count} ({reason})"))
        .collect::<Vec<_>>()
        .join(", ")
}

/// What was learnt from what, and the held-out figures: per task first, because the pooled one misleads.
fn table(verifier: &Verifier) -> String {
    let Description { policy, evidence, held_out, .. } = verifier.description();
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
    rows.push(
        [&["  pooled (rises by telling easy tasks from hard ones)".to_owned()], pooled.as_slice()]
            .concat(),
    );
    format!(
        "verifier {} for policy {}\nfitted to {} episodes ({} successes, {} steps) in {} passes, held out {} ({} successes, {} steps)\n{}held-out loss {}, Brier score {}, calibration error {} ({} bins)\n",
        short(verifier.digest()),
        short(policy),
        evidence.training_episodes,
        evidence.training_successes,
        evidence.training_samples,
        evidence.epochs,
        evidence.held_out_episodes,
        evidence.held_out_successes,
        evidence.held_out_samples,
        aligned(&rows),
        figure(held_out.loss),
        figure(held_out.brier_score),
        figure(held_out.calibration_error),
        held_out.reliability.len(),
    ) + &choice_text(verifier)
}

/// What the choice part is worth beside the medoid, by decisions taken one at a time.
fn choice_text(verifier: &Verifier) -> String {
    let Some(choice) = &verifier.description().choice else {
        return "no choice part: it takes `rever collect --candidates 5` and no --plain\n"
            .to_owned();
    };
    let gain = |gain: &Gain| format!("{:+.1} ± {:.1}", gain.points, gain.standard_error);
    format!(
        "choosing, from {} episodes ({} decisions): changing one decision at a time would bring {} points in sum, the medoid {} (cross-fitted, ± one standard error)\n",
        choice.episodes,
        choice.decisions,
        gain(&choice.gain),
        gain(&choice.medoid_gain),
    )
}

fn figure(value: Option<f64>) -> String {
    value.map_or("–".to_owned(), |value| format!("{value:.3}"))
}

/// The first digits of a digest: enough to tell versions apart by eye.
fn short(digest: &str) -> &str {
    digest.get(..12).unwrap_or(digest)
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
            println!("keeping it for agents that start later; Ctrl-C ends");
            tokio::signal::ctrl_c().await?;
        }
        drop(publisher);
        network.close().await
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two tasks, of which only the first has failures.
    fn verifier() -> Verifier {
        let episode = |number: usize| LabelledEpisode {
            name: format!("{number:02}"),
            instruction: String::new(),
            task: if number < 20 { "mixed" } else { "easy" }.to_owned(),
            is_success: number >= 10,
            hidden: (0..40)
                .map(|step| if number < 10 { step as f32 } else { -1.0 - step as f32 })
                .collect(),
            steps: (0..40).collect(),
            steps_total: 40,
            decisions: None,
        };
        let set = TrainingSet::new(1, (0..30).map(episode)).expect("a whole set");
        let options = Options {
            hidden_sizes: [8, 4],
            epochs_max: 30,
            learning_rate: 1e-2,
            ..Options::default()
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
        let fitted = "fitted to 24 episodes (16 successes, 960 steps) in ";
        assert!(
            table.contains(fitted)
                && table.contains(" passes, held out 6 (4 successes, 240 steps)\n"),
            "{table}"
        );
    }

    #[test]
    fn reasons_are_counted_in_words() {
        assert_eq!(counts(&BTreeMap::new()), "none");
        assert_eq!(
            counts(&BTreeMap::from([("greedy", 3), ("no outcome", 1)])),
            "3 (greedy), 1 (no outcome)"
        );
    }
}
