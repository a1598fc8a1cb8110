//! The sessions of a run: opened where there is room, used for one episode after the other.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use anyhow::{Result, bail, ensure};
use protocol::{Open, PROTOCOL_VERSION, TaskDescription};

use super::attempt::Seat;
use super::queue::Job;
use crate::servers::LocalServers;
use crate::wire::{
    ACTION_LENGTH, Environment, EnvironmentFault, Network, STATE_LENGTH, ServerDescription,
};

/// A run with nothing left to do but wait for a server gives up after this long.
const SERVER_WAIT: Duration = Duration::from_secs(60);
/// How long a look waits for servers to answer.
const LOOK_WAIT: Duration = Duration::from_secs(2);
/// How often a run looks for servers while one that was there is gone.
const LOOK_EVERY: Duration = Duration::from_secs(5);
/// How often it looks for more than it has ever had.
const LOOK_EVERY_WHEN_COMPLETE: Duration = Duration::from_secs(30);
/// A server that did not answer in time may do so again: before a run that waits for it gives up.
const AVOIDED_FOR: Duration = Duration::from_secs(30);

/// Opens sessions and keeps those that are free.
pub struct Crew<'a> {
    network: &'a Network,
    local: Option<&'a LocalServers>,
    image_size: (usize, usize),
    holder: String,
    /// All episodes of a run happen in one simulator of one version.
    simulator: Option<String>,
    servers: Vec<ServerDescription>,
    /// The most that lived at once; with fewer, more may come.
    servers_max: usize,
    /// Servers that did not answer in time, and since when they are left alone.
    avoided: BTreeMap<String, Instant>,
    /// Servers with another simulator.
    strangers: BTreeSet<String>,
    /// Whether one with the run's simulator has been there.
    servers_seen: bool,
    free: Vec<(Seat, Environment)>,
    /// Sessions of this run by server.
    in_use: BTreeMap<String, usize>,
    looked: Option<Instant>,
}

impl<'a> Crew<'a> {
    /// Sessions with images of `image_size` (height, width); `simulator` is that of the episodes that
    /// the run has already; `servers` are said to be there.
    pub fn new(
        network: &'a Network,
        local: Option<&'a LocalServers>,
        image_size: (usize, usize),
        holder: &str,
        simulator: Option<String>,
        servers: usize,
    ) -> Crew<'a> {
        Crew {
            network,
            local,
            image_size,
            holder: holder.to_owned(),
            simulator,
            servers: Vec::new(),
            servers_max: servers,
            avoided: BTreeMap::new(),
            strangers: BTreeSet::new(),
            servers_seen: false,
            free: Vec::new(),
            in_use: BTreeMap::new(),
            looked: None,
        }
    }

    /// A session for a job. None when there is none at the moment; `must` waits for one and fails
    /// when none comes.
    pub async fn seat(&mut self, job: &Job, must: bool) -> Result<Option<(Seat, Environment)>> {
        let is_short = self.servers.len() < self.servers_max;
        self.look(job, if is_short { LOOK_EVERY } else { LOOK_EVERY_WHEN_COMPLETE }, 1).await?;
        // All servers of a run are of one simulator: another one would not fit better.
        if let Some(reason) = self.servers.iter().find_map(|server| unfit(server, job)) {
            bail!("{reason}");
        }
        let has_expert = job.arm.strategy.needs_expert();
        if let Some(index) = self.free.iter().position(|(seat, _)| seat.has_expert == has_expert) {
            return Ok(Some(self.free.swap_remove(index)));
        }
        // One of the other kind makes room: a session's kind is settled when it is opened.
        if let Some((seat, environment)) = self.free.pop() {
            self.count(&seat.server, false);
            if let Err(fault) = environment.close().await {
                tracing::warn!("a session of server {} was not closed: {fault}", seat.server);
            }
        }
        let deadline = Instant::now() + SERVER_WAIT;
        loop {
            let refusals = match self.open(job, has_expert).await {
                Ok(opened) => return Ok(Some(opened)),
                Err(refusals) => refusals,
            };
            if !must {
                return Ok(None);
            }
            if let Some(reason) = self.local.and_then(LocalServers::given_up) {
                bail!("{reason}");
            }
            ensure!(
                Instant::now() < deadline,
                "no session was to be had within {} s: {}",
                SERVER_WAIT.as_secs(),
                self.absent(refusals)
            );
            self.look(job, Duration::ZERO, self.servers.len() + 1).await?;
        }
    }

    /// Why there is no session.
    fn absent(&self, mut reasons: Vec<String>) -> String {
        let slow = self.avoided.keys();
        reasons.extend(slow.map(|server| format!("server {server} did not answer in time")));
        let others = self.strangers.iter();
        reasons.extend(others.map(|server| format!("server {server} has another simulator")));
        if reasons.is_empty() { "no server lives".to_owned() } else { reasons.join("; ") }
    }

    /// Takes back the session of an episode that ended well.
    pub fn free(&mut self, seat: Seat, environment: Environment) {
        let in_use = |server: &str| self.in_use.get(server).copied().unwrap_or(0);
        let fewest = self.servers.iter().map(|server| in_use(&server.server)).min().unwrap_or(0);
        if in_use(&seat.server) > fewest + 1 {
            // Another server has come (back): the next session is opened there.
            self.count(&seat.server, false);
        } else {
            self.free.push((seat, environment));
        }
    }

    /// The session broke; its server may have, too.
    pub fn lost(&mut self, seat: &Seat, fault: &EnvironmentFault) {
        self.count(&seat.server, false);
        let is_server_lost = match fault {
            EnvironmentFault::ServerLost { .. } => true,
            EnvironmentFault::TimedOut { .. } => {
                self.avoided.insert(seat.server.clone(), Instant::now());
                if let Some(local) = self.local {
                    local.replace(&seat.server);
                }
                true
            }
            EnvironmentFault::Refused { .. }
            | EnvironmentFault::Faulted { .. }
            | EnvironmentFault::Wire { .. } => false,
        };
        if is_server_lost {
            self.servers.retain(|server| server.server != seat.server);
            self.free.retain(|(free, _)| free.server != seat.server);
            self.in_use.remove(&seat.server);
            self.looked = None;
        }
    }

    /// Asks who is there, unless that was asked within `interval`; waits a little for `count` of them.
    ///
    /// A fleet may have servers of other simulators. Without any of the run's own, from the beginning on, they are an error.
    async fn look(&mut self, job: &Job, interval: Duration, count: usize) -> Result<()> {
        if self.looked.is_some_and(|looked| looked.elapsed() < interval) {
            return Ok(());
        }
        let mut servers = self.network.servers(count, LOOK_WAIT).await;
        self.avoided.retain(|_, since| since.elapsed() < AVOIDED_FOR);
        servers.retain(|server| !self.avoided.contains_key(&server.server));
        self.looked = Some(Instant::now());
        let first = servers.iter().find(|server| offered(server, job).is_some());
        let Some(expected) = self.simulator.clone().or_else(|| first.map(simulator)) else {
            self.servers = servers;
            return Ok(());
        };
        let (ours, others): (Vec<_>, Vec<_>) =
            servers.into_iter().partition(|server| simulator(server) == expected);
        for other in others {
            let ServerDescription { server, .. } = &other;
            let words = format!(
                "server {server}: expected the run's simulator, {expected}, got {}",
                simulator(&other)
            );
            if ours.is_empty() && !self.servers_seen {
                bail!(words);
            }
            if self.strangers.insert(server.clone()) {
                tracing::warn!("{words}; it is left out");
            }
        }
        self.servers_seen |= !ours.is_empty();
        self.simulator = Some(expected);
        self.servers_max = self.servers_max.max(ours.len());
        self.servers = ours;
        Ok(())
    }

    /// Opens a session on the server with the fewest of this run; what the servers said when none has room.
    async fn open(
        &mut self,
        job: &Job,
        has_expert: bool,
    ) -> Result<(Seat, Environment), Vec<String>> {
        let mut servers: Vec<(String, String)> =
            self.servers.iter().map(|server| (server.server.clone(), simulator(server))).collect();
        servers.sort_by_key(|(server, _)| self.in_use.get(server).copied().unwrap_or(0));
        let mut refusals = Vec::new();
        for (server, simulator) in servers {
            let open = Open {
                protocol: PROTOCOL_VERSION,
                task: job.identity.task.clone(),
                variant: job.identity.variant.clone(),
                image_height: self.image_size.0 as u32,
                image_width: self.image_size.1 as u32,
                expert: has_expert,
                holder: self.holder.clone(),
            };
            match Environment::open(self.network, &server, open).await {
                Ok(environment) => {
                    self.count(&server, true);
                    return Ok((Seat { server, simulator, has_expert }, environment));
                }
                Err(fault) => {
                    let is_refusal = matches!(fault, EnvironmentFault::Refused { .. });
                    refusals.push(format!("server {server}: {fault}"));
                    if !is_refusal {
                        self.servers.retain(|other| other.server != server);
                    }
                }
            }
        }
        Err(refusals)
    }

    fn count(&mut self, server: &str, is_more: bool) {
        let count = self.in_use.entry(server.to_owned()).or_default();
        *count = if is_more { *count + 1 } else { count.saturating_sub(1) };
    }
}

/// What a server offers for a job.
fn offered<'a>(server: &'a ServerDescription, job: &Job) -> Option<&'a TaskDescription> {
    let (task, variant) = (&job.identity.task, &job.identity.variant);
    server.tasks.iter().find(|one| one.task == *task && one.variant == *variant)
}

/// Why policies, which are made for Bridge's states and actions, cannot act in a server's task.
fn unfit(server: &ServerDescription, job: &Job) -> Option<String> {
    let (task, offered) = (&job.identity.task, offered(server, job)?);
    let got = (offered.state.len(), offered.action.len());
    (got != (STATE_LENGTH, ACTION_LENGTH)).then(|| {
        format!(
            "server {}: task {task}: expected a state of {STATE_LENGTH} and an action of \
             {ACTION_LENGTH} numbers, as the policy has, got {} and {}",
            server.server, got.0, got.1
        )
    })
}

/// What a run's episodes must have in common: a task of another version has other results.
fn simulator(server: &ServerDescription) -> String {
    let name = format!("{} {}", server.simulator, server.simulator_version);
    let versions: BTreeSet<u32> = server.tasks.iter().map(|task| task.version).collect();
    // Left out where every task is its first version, as in runs from before there was a second.
    if versions.iter().all(|&version| version == 1) {
        return name;
    }
    let versions: Vec<String> = versions.iter().map(u32::to_string).collect();
    format!("{name}, task version {}", versions.join(" and "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn server(versions: &[u32]) -> ServerDescription {
        let task = |&version: &u32| TaskDescription {
            task: format!("task {version}"),
            variant: "default".to_owned(),
            version,
            instruction: String::new(),
            steps_max: 1,
            control_hz: None,
            layouts: 0,
            state: Vec::new(),
            action: Vec::new(),
        };
        ServerDescription {
            protocol: PROTOCOL_VERSION,
            server: "some".to_owned(),
            simulator: "world".to_owned(),
            simulator_version: "3".to_owned(),
            tasks: versions.iter().map(task).collect(),
            image_side_max: 0,
            sessions: 0,
            sessions_max: 1,
            slots_max: 1,
        }
    }

    #[test]
    fn another_version_of_a_task_is_another_simulator() {
        assert_eq!(simulator(&server(&[1, 1])), "world 3");
        assert_eq!(simulator(&server(&[2, 2])), "world 3, task version 2");
        assert_eq!(simulator(&server(&[2, 1])), "world 3, task version 1 and 2");
    }
}
