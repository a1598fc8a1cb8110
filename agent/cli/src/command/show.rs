//! `rever show`: describes a run, a verifier or a policy without running anything.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use serde_json::Value;
use store::run;
use verifier::Verifier;
use vla::CompletionParser;

use super::policy::CheckpointArguments;
use super::{Output, WrongUsage, episodes, train};

/// Show the results of a run, the metrics of a verifier or the sizes of a policy
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  rever show runs/evaluate-1a2b3c4d        its results; with -v all tables
  rever show verifier.safetensors          its training data and held-out metrics
  rever show FOLDER                        a checkpoint's sizes, prompt and digest")]
pub struct Arguments {
    /// Folder of a run, file of a verifier or folder of a checkpoint
    path: PathBuf,
    #[command(flatten)]
    checkpoint: CheckpointArguments,
}

/// Prints the description.
pub fn run(arguments: &Arguments, output: Output) -> Result<()> {
    let path = &arguments.path;
    if path.is_file() {
        print!("{}", train::table(&Verifier::load_any(path)?));
        println!("next: rever evaluate --strategies sample,verifier --verifier {}", path.display());
        Ok(())
    } else if path.join("config.json").is_file() {
        show_policy(path, &arguments.checkpoint)
    } else {
        run::read_header(path).map_err(|error| {
            WrongUsage(format!(
                "show: expected a run's folder (run.json), a checkpoint's folder (config.json) or a verifier's file; \
                 `rever list runs` lists runs: {error:#}"
            ))
        })?;
        show_run(path, output)
    }
}

fn show_run(path: &Path, output: Output) -> Result<()> {
    let (results, provenance) = episodes::results(path)?;
    print!("{}", output.results(&results));
    let (recorded, planned) = (run::recorded(path)?.len(), episodes::planned(&provenance));
    println!("{recorded} of {planned} episodes recorded");
    let starts = provenance["starts"].as_array().map_or(&[][..], Vec::as_slice);
    for start in starts {
        let words = start["command"].as_array().map_or(&[][..], Vec::as_slice);
        let words: Vec<&str> = words.iter().filter_map(Value::as_str).collect();
        let (time, commit) = (text(&start["time"]), text(&start["build"]["commit"]));
        println!("{time}, commit {commit}: {}", words.join(" "));
    }
    for name in ["policy", "verifier"] {
        println!("{name}: {}", text(&provenance["versions"][name]));
    }
    println!("next: rever report {}", path.display());
    Ok(())
}

fn show_policy(folder: &Path, options: &CheckpointArguments) -> Result<()> {
    let parser = CompletionParser::load(folder, &options.options())?;
    println!("policy {}: digest {}", folder.display(), parser.digest());
    for (name, value) in parser.description() {
        println!("  {name:<22} {value}");
    }
    println!("next: rever evaluate --policy {}{}", folder.display(), options.words());
    Ok(())
}

fn text(value: &Value) -> &str {
    value.as_str().unwrap_or("-")
}
