//! `rever digest`: computes one digest over all episodes of a run, to compare runs.

use std::path::PathBuf;

use anyhow::{Result, ensure};
use clap::Args;
use store::record::EpisodeRecord;
use store::run::{record_path, recorded};
use store::{combined_digest, episode_digest, hex};

/// Print a digest of the episodes of a run
///
/// SHA-256 over episode identities, candidate tokens, choices, statistics and states. Runs of the same suite have the same
/// digest on every machine: the number of servers, the order of episodes and interruptions do not change it.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Folder of the run
    run: PathBuf,
    /// Also print the digest of each episode
    #[arg(long)]
    episodes: bool,
}

/// Prints the digest. Only one record is in memory at a time.
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
