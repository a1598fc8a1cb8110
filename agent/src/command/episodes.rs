//! The arguments that every command which runs episodes takes.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;

use crate::campaign::Campaign;
use crate::policy::DeviceName;
use crate::rollout::Keep;
use crate::setup;
use crate::simulator::Simulator;
use crate::site::Site;
use crate::suite::{Arm, Suite, TASKS};

/// Processes on this machine unless others are named.
const SERVERS_DEFAULT: u16 = 2;

/// Which tasks, where, and what is kept of them.
#[derive(Debug, Clone, Args)]
pub struct EpisodesArguments {
    /// Tasks, separated by commas; all four by default.
    #[arg(long, value_delimiter = ',', default_values_t = TASKS.map(str::to_owned))]
    pub tasks: Vec<String>,
    /// Another number gives other layouts and other samples.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// The checkpoint's folder [default: the one that comes with rever].
    #[arg(long)]
    pub policy: Option<PathBuf>,
    /// Where the policy computes: cpu, cuda or cuda:N.
    #[arg(long, default_value_t)]
    pub device: DeviceName,
    /// The verifier's file [default: the one beside the policy's weights, if there is one].
    #[arg(long)]
    pub verifier: Option<PathBuf>,
    /// Take up every new verifier that is published under this name, between episodes.
    #[arg(long, value_name = "NAME")]
    pub follow_verifier: Option<String>,
    /// Server processes to start on this machine [default: 2].
    #[arg(long, conflicts_with = "connect", value_parser = clap::value_parser!(u16).range(1..=64))]
    pub servers: Option<u16>,
    /// What these processes are.
    #[arg(long, value_enum, default_value_t, conflicts_with = "connect")]
    pub simulator: Simulator,
    /// Use servers that run already: endpoints of them or of a router, as tcp/HOST:PORT.
    #[arg(long, value_delimiter = ',')]
    pub connect: Vec<String>,
    /// Listen here for others, such as a trainer that publishes verifiers [default: a socket of this machine, told at the start].
    #[arg(long, value_name = "ENDPOINT", value_delimiter = ',')]
    pub listen: Vec<String>,
    /// Only servers of the same fleet are used.
    #[arg(long, default_value = "local")]
    pub fleet: String,
    /// Episodes at once.
    #[arg(long, default_value_t = 16, value_parser = clap::value_parser!(u16).range(1..=256))]
    pub sessions: u16,
    /// The run's folder; started again with the same options it goes on [default: under runs/].
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// The label store that takes the outcomes.
    #[arg(long, default_value = "runs/labels.sqlite")]
    pub labels: PathBuf,
    /// Keep a video of every episode.
    #[arg(long)]
    pub video: bool,
    /// Keep the hidden states of all candidates, not only of the executed ones.
    #[arg(long)]
    pub all_hidden: bool,
    /// A Python that has the packages of env-server, instead of the one that rever sets up.
    #[arg(long, value_name = "FILE")]
    pub python: Option<PathBuf>,
}

impl EpisodesArguments {
    /// The campaign that these arguments, a suite and its arms make.
    pub fn campaign(&self, title: &str, suite: Suite, arms: Vec<Arm>) -> Result<Campaign> {
        let policy = policy_folder(self.policy.as_ref())?;
        let beside = policy.join("verifier.safetensors");
        let verifier = self.verifier.clone().or_else(|| beside.is_file().then_some(beside));
        Ok(Campaign {
            title: title.to_owned(),
            suite,
            arms,
            policy,
            device: self.device,
            // Whoever follows a verifier starts with a named one or with the first that is published.
            verifier: if self.follow_verifier.is_some() { self.verifier.clone() } else { verifier },
            follow_verifier: self.follow_verifier.clone(),
            site: self.site(),
            sessions: usize::from(self.sessions),
            out: self.out.clone(),
            labels: self.labels.clone(),
            keep: Keep { all_hidden: self.all_hidden, video: self.video },
        })
    }

    /// Where the servers are.
    fn site(&self) -> Site {
        let started = self.servers.unwrap_or(SERVERS_DEFAULT);
        Site {
            servers: if self.connect.is_empty() { usize::from(started) } else { 0 },
            simulator: self.simulator,
            connect: self.connect.clone(),
            listen: self.listen.clone(),
            fleet: self.fleet.clone(),
            python: self.python.clone(),
        }
    }
}

/// The named checkpoint, or the one that comes with the program.
pub fn policy_folder(named: Option<&PathBuf>) -> Result<PathBuf> {
    match named {
        Some(folder) => Ok(folder.clone()),
        None => Ok(setup::repository()?.join("agent/models/bridge-small")),
    }
}
