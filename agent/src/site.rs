//! Where the world is: servers on this machine, or at an endpoint.

use std::path::PathBuf;

use anyhow::{Context, Result};
use tokio::runtime::Runtime;

use crate::servers::{LocalServerOptions, LocalServers};
use crate::setup::{self, PythonEnvironment};
use crate::simulator::{ServerProgram, Simulator};
use crate::wire::{Network, NetworkOptions};

/// Where environment servers are.
#[derive(Debug, Clone, Default)]
pub struct Site {
    /// Processes to start here; 0 when `connect` names others.
    pub servers: usize,
    /// What they are.
    pub simulator: Simulator,
    /// Endpoints of a router or of servers that run already.
    pub connect: Vec<String>,
    /// Endpoints that others may connect to, such as a trainer. Servers that are started here have one of their own.
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
        let program = if self.servers > 0 { Some(self.program()?) } else { None };
        let network = runtime.block_on(Network::open(self.network_options()))?;
        let local = program.map(|program| self.start(program, &network, sessions)).transpose()?;
        let result = runtime.block_on(work(&network, local.as_ref()));
        // Servers first: they would report the network's end as an error.
        drop(local);
        runtime.block_on(network.close())?;
        result
    }

    /// What local servers are started with; the first time takes minutes.
    pub fn program(&self) -> Result<ServerProgram> {
        ServerProgram::prepare(self.simulator, self.python_environment()?)
    }

    /// The Python that local servers run on, set up when it is first asked for.
    pub fn python_environment(&self) -> Result<PythonEnvironment> {
        let repository = setup::repository()?;
        match &self.python {
            Some(python) => Ok(PythonEnvironment {
                python: python.clone(),
                package_root: repository.join("env-server"),
            }),
            None => match self.simulator {
                Simulator::Robosuite => setup::simulators_environment(&repository),
                Simulator::Python | Simulator::Native => setup::python_environment(&repository),
            },
        }
    }

    /// Local servers connect to this agent; to reach others nothing needs to listen here.
    pub fn network_options(&self) -> NetworkOptions {
        NetworkOptions {
            connect: self.connect.clone(),
            listen_here: self.servers > 0,
            listen: self.listen.clone(),
            fleet: self.fleet.clone(),
            ..NetworkOptions::default()
        }
    }

    /// Starts the local servers and waits until they are ready. Blocks.
    pub fn start(
        &self,
        program: ServerProgram,
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
        LocalServers::start(program, &options)
    }
}
