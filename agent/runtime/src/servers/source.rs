//! The servers of a run: processes started on this machine, or endpoints.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use tokio::runtime::Runtime;

use super::installation::{Installation, Missing};
use super::local::{LocalServerOptions, LocalServers};
use super::native;
use super::program::{ServerProgram, Simulator};
use super::python::{
    PythonEnvironment, named_environment, servers_environment, simulators_environment,
};
use crate::wire::{Fleet, Network, NetworkOptions};

/// Discovery timeout for servers that are already running.
const SERVERS_WAIT: Duration = Duration::from_secs(10);
/// Maximum time without progress of a local server. Opening a session may take nearly as long. A
/// frozen server with running episodes is detected much earlier, by requests without a reply.
const SILENCE_MAX: Duration = Duration::from_secs(60);

/// The servers of a run.
#[derive(Debug, Clone)]
pub struct ServerSource {
    /// Processes to start on this machine; `None` if `connect` names other servers.
    pub local: Option<LocalSource>,
    /// Endpoints of a router or of running servers.
    pub connect: Vec<String>,
    /// Endpoints that other programs may connect to, such as a trainer. Local servers use another
    /// endpoint.
    pub listen: Vec<String>,
    /// Peers see each other only within the same fleet.
    pub fleet: String,
}

/// Servers to start on this machine.
#[derive(Debug, Clone)]
pub struct LocalSource {
    /// Number of processes.
    pub count: usize,
    /// The simulator of the processes.
    pub simulator: Simulator,
    /// A Python with all packages installed, instead of the environment that rever installs.
    pub python: Option<PathBuf>,
    /// The program's own files.
    pub installation: Installation,
}

/// An open network and the servers started for it.
pub struct Deployment {
    /// The requested servers.
    pub source: ServerSource,
    /// The connection to all servers.
    pub network: Network,
    /// The servers on this machine.
    pub local: Option<Arc<LocalServers>>,
}

impl Deployment {
    /// The servers found before the timeout; fails if there are none.
    pub async fn first_servers(&self) -> Result<Fleet> {
        let local = self.local.as_ref().map_or(0, |local| local.server_ids().len());
        let fleet = self.network.servers(local.max(1), SERVERS_WAIT).await;
        if !fleet.servers.is_empty() {
            return Ok(fleet);
        }
        if let Some(reason) = self.local.as_ref().and_then(|local| local.given_up()) {
            bail!("{reason}");
        }
        let place = match &self.source.connect[..] {
            [] => String::new(),
            connect => format!(" at {}", connect.join(", ")),
        };
        let mut text =
            format!("no environment server found{place} (fleet {:?})", self.source.fleet);
        for (server, reason) in &fleet.undescribed {
            text.push_str(&format!("; server {server}: {reason}"));
        }
        bail!(text)
    }

    /// Ends the local servers, then closes the network. Blocks.
    pub fn close(self, runtime: &Runtime) -> Result<()> {
        // Servers end first, otherwise they would report the closed network as an error.
        drop(self.local);
        runtime.block_on(self.network.close())
    }
}

impl ServerSource {
    /// Opens the network and starts the local servers, each with up to `sessions` sessions. Blocks.
    /// Missing dependencies of the servers are installed first, which may take minutes.
    pub fn open(&self, runtime: &Runtime, sessions: usize) -> Result<Deployment> {
        let local = self.local.as_ref();
        let program = local.map(|local| local.program(Missing::Install)).transpose()?;
        self.open_with(program, runtime, sessions)
    }

    /// The same with the installed program of the local servers.
    pub fn open_with(
        &self,
        program: Option<ServerProgram>,
        runtime: &Runtime,
        sessions: usize,
    ) -> Result<Deployment> {
        let network = runtime.block_on(Network::open(self.network_options()))?;
        let local = program.map(|program| self.start(program, &network, sessions)).transpose()?;
        Ok(Deployment { source: self.clone(), network, local: local.map(Arc::new) })
    }

    /// Number of local servers.
    pub fn local_count(&self) -> usize {
        self.local.as_ref().map_or(0, |local| local.count)
    }

    /// Local servers connect to this agent. For other servers this agent does not listen.
    pub fn network_options(&self) -> NetworkOptions {
        NetworkOptions {
            connect: self.connect.clone(),
            listen_here: self.local.is_some(),
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
            count: self.local_count(),
            connect: network
                .listening()
                .first()
                .context("the network has no listening endpoint")?
                .clone(),
            fleet: self.fleet.clone(),
            // If other servers end, each one must be able to serve all sessions.
            sessions_each: sessions,
            silence_max: SILENCE_MAX,
        };
        let network = network.clone();
        LocalServers::start(program, &options, move |server| network.last_beat(server))
    }
}

impl LocalSource {
    /// The program of the servers. Installing it takes a minute or two.
    pub fn program(&self, missing: Missing) -> Result<ServerProgram> {
        let python = self.python_environment(missing)?;
        Ok(match self.simulator {
            Simulator::Python => ServerProgram::Python(python),
            Simulator::Robosuite => ServerProgram::Robosuite(python),
            Simulator::Native => native::prepare(&self.installation, &python, missing)?,
        })
    }

    /// The Python environment of the servers, or the one whose MuJoCo they use.
    pub fn python_environment(&self, missing: Missing) -> Result<PythonEnvironment> {
        match (&self.python, self.simulator) {
            (Some(python), simulator) => {
                named_environment(&self.installation, python, simulator, missing)
            }
            (None, Simulator::Robosuite) => simulators_environment(&self.installation, missing),
            (None, Simulator::Python | Simulator::Native) => {
                servers_environment(&self.installation, missing)
            }
        }
    }
}
