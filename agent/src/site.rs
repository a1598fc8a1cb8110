//! Where the world is: servers on this machine, or at an endpoint.

use std::path::PathBuf;

use anyhow::{Context, Result};
use tokio::runtime::Runtime;

use crate::servers::{LocalServerOptions, LocalServers};
use crate::setup::{self, PythonEnvironment};
use crate::wire::{Network, NetworkOptions};

/// Where environment servers are.
#[derive(Debug, Clone)]
pub struct Site {
    /// Processes to start here; 0 when `connect` names others.
    pub servers: usize,
    /// Endpoints of a router or of servers that run already.
    pub connect: Vec<String>,
    /// Endpoints that others may connect to, such as a trainer; a free loopback port when servers are started here.
    pub listen: Vec<String>,
    /// Who meets whom.
    pub fleet: String,
    /// A Python that has the packages already, instead of the one that is set up.
    pub python: Option<PathBuf>,
}

impl Site {
    /// Opens the network, starts the local servers if there are any, works, and ends both. Blocks.
    pub fn run<T>(
        &self,
        runtime: &Runtime,
        sessions: usize,
        work: impl AsyncFnOnce(&Network, Option<&LocalServers>) -> Result<T>,
    ) -> Result<T> {
        let python = if self.servers > 0 { Some(self.python_environment()?) } else { None };
        let network = runtime.block_on(Network::open(self.network_options()))?;
        let local = python.map(|python| self.start(&python, &network, sessions)).transpose()?;
        let result = runtime.block_on(work(&network, local.as_ref()));
        // Servers first: they would report the network's end as an error.
        drop(local);
        runtime.block_on(network.close())?;
        result
    }

    /// The Python that local servers run on.
    pub fn python_environment(&self) -> Result<PythonEnvironment> {
        let repository = setup::repository()?;
        match &self.python {
            Some(python) => Ok(PythonEnvironment {
                python: python.clone(),
                package_root: repository.join("env-server"),
            }),
            None => setup::python_environment(&repository),
        }
    }

    /// Local servers connect to this agent; to reach others nothing needs to listen here.
    pub fn network_options(&self) -> NetworkOptions {
        let defaults = NetworkOptions::default();
        let needs_port = self.listen.is_empty() && self.servers > 0;
        NetworkOptions {
            connect: self.connect.clone(),
            listen: if needs_port { defaults.listen } else { self.listen.clone() },
            fleet: self.fleet.clone(),
            multicast: defaults.multicast,
            timing: defaults.timing,
        }
    }

    /// Starts the local servers and waits until they are ready. Blocks.
    pub fn start(
        &self,
        python: &PythonEnvironment,
        network: &Network,
        sessions: usize,
    ) -> Result<LocalServers> {
        let options = LocalServerOptions {
            count: self.servers,
            connect: network.listening().first().context("the network listens nowhere")?.clone(),
            fleet: self.fleet.clone(),
            // Each could serve all of them, should the others die.
            sessions_each: sessions,
        };
        LocalServers::start(python, &options)
    }
}
