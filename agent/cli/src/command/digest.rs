//! `rever digest`: what the episodes of a run did, as one number to compare.

use std::path::PathBuf;

use anyhow::{Result, ensure};
use clap::Args;
use store::record::EpisodeRecord;
use store::run::{record_path, recorded};
use store::{combined_digest, episode_digest, hex};

/// Print a digest of what the episodes of a run did
///
/// SHA-256 over identity, candidates' tokens, choices, statistics and states. Runs of one suite have one digest on every
/// machine, whatever the number of servers, the order of episodes or interruptions.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The run's folder
    run: PathBuf,
    /// Print the digest of each episode as well
    #[arg(long)]
    episodes: bool,
}

/// Reads one record after the other.
pub fn run(arguments: Arguments) -> Result<()> {
    let mut digests = Vec::new();
    for id in recorded(&arguments.run)? {
        let digest = episode_digest(&EpisodeRecord::read(&record_path(&arguments.run, &id))?);
        if arguments.episodes {
            println!("{} {id}", hex(&digest));
        }
        digests.push(digest);
    }
    ensure!(
        !digests.is_empty(),
        "{}: expected recorded episodes, got none",
        arguments.run.display()
    );
    let count = digests.len();
    println!("{} {count} episodes", combined_digest(digests));
    Ok(())
}
