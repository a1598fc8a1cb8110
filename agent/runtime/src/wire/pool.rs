//! The session pool of a run: opens sessions on servers with free ones and reuses them for
//! consecutive episodes.
//!
//! Sessions are opened in the background, and an episode takes the first free one. A server that
//! does not reply costs only the episodes that it runs: it is skipped for an increasing time
//! (backoff), and until it has opened one session it is asked for one at a time.

use std::pin::pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::{Result, bail};
use decision::TaskId;
use protocol::{Description, Open, PROTOCOL_VERSION, TaskDescription};
use tokio::sync::{Notify, watch};
use tokio::time::Instant;

use super::discovery::Fleet;
use super::offer::{difference, offered, simulator};
use super::pool_state::{BACKOFF, BACKOFF_MAX, REFUSED_PAUSE, State};
use super::{Environment, Network};
use crate::fault::EnvironmentFault;
use crate::servers::LocalServers;
use crate::session::{Session, SessionInfo, SessionPool, SessionRequest};

/// How long a run without sessions waits before it reports what it waits for.
const REPORT_AFTER: Duration = Duration::from_secs(2);
/// If all servers that offer the task are incompatible with the run, how long to wait for another
/// server.
const INCOMPATIBLE_WAIT: Duration = Duration::from_secs(2);

/// Properties of all sessions of a run.
#[derive(Debug, Clone)]
pub struct PoolOptions {
    /// Height and width of the images that the policy expects.
    pub image_size: (usize, usize),
    /// Number of dimensions of the policy's actions.
    pub action_length: usize,
    /// The holder's name, for the server's log.
    pub holder: String,
    /// The simulator of the run's existing episodes.
    pub simulator: Option<String>,
    /// How long a run waits for its first session.
    pub first_wait: Duration,
    /// How long a run waits for a session after it has lost all of them.
    pub wait: Duration,
}

/// Opens sessions over zenoh.
pub struct ZenohPool(Arc<Pool>);

struct Pool {
    network: Network,
    local: Option<Arc<LocalServers>>,
    options: PoolOptions,
    fleet: watch::Receiver<Fleet>,
    state: Mutex<State>,
    /// A session was returned, or an attempt to open one ended.
    freed: Notify,
}

/// A server on which a session will be opened.
struct Chosen {
    begun: Instant,
    server: String,
    simulator: String,
    task: TaskDescription,
}

impl ZenohPool {
    /// A pool on a network; `local` are the servers started by this process.
    pub fn new(
        network: Network,
        local: Option<Arc<LocalServers>>,
        options: PoolOptions,
    ) -> ZenohPool {
        let fleet = network.fleet();
        let state = State { simulator: options.simulator.clone(), ..State::default() };
        let (state, freed) = (Mutex::new(state), Notify::new());
        ZenohPool(Arc::new(Pool { network, local, options, fleet, state, freed }))
    }
}

impl Pool {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An idle session on a server that offers the task.
    fn idle(&self, request: &SessionRequest, fleet: &Fleet) -> Option<Session<Environment>> {
        let mut state = self.state();
        let fits = |(session, has_expert): &(Session<Environment>, bool)| {
            let description = fleet.servers.get(&session.info.server);
            let task = description.and_then(|server| offered(server, &request.task));
            task.filter(|_| *has_expert == request.needs_expert).cloned()
        };
        let found =
            state.idle.iter().enumerate().find_map(|(index, one)| Some((index, fits(one)?)));
        let (index, task) = found?;
        let (mut session, _) = state.idle.swap_remove(index);
        session.info.task = task;
        Some(session)
    }

    /// Reserves a session on the server with the fewest sessions of this run, among those that may
    /// be asked now.
    fn reserve(&self, request: &SessionRequest, fleet: &Fleet) -> Option<Chosen> {
        let mut state = self.state();
        let now = Instant::now();
        if state.is_enough_opening() {
            return None;
        }
        self.check_compatible(&mut state, &request.task, fleet);
        let may_be_asked = |server: &&Description| {
            let id = &server.server;
            let opening = state.in_use.get(id).copied().unwrap_or(0);
            offered(server, &request.task).is_some()
                && !state.incompatible.contains_key(id)
                && state.backoff.get(id).is_none_or(|backoff| backoff.until <= now)
                && (opening == 0 || state.proven.contains(id))
        };
        let fewest = |server: &&Description| state.in_use.get(&server.server).copied().unwrap_or(0);
        let chosen = fleet.servers.values().filter(may_be_asked).min_by_key(fewest)?;
        let chosen = Chosen {
            begun: now,
            server: chosen.server.clone(),
            simulator: simulator(chosen),
            task: offered(chosen, &request.task)?.clone(),
        };
        state.add(&chosen.server, 1);
        state.opening.push((now, chosen.server.clone()));
        // Whether a session includes the expert's action is fixed when it is opened: an idle
        // session of the other kind is closed to make room.
        let is_other = |(idle, has_expert): &(Session<Environment>, bool)| {
            idle.info.server == chosen.server && *has_expert != request.needs_expert
        };
        let other = state.idle.iter().position(is_other);
        if let Some(index) = other {
            let (idle, _) = state.idle.swap_remove(index);
            state.add(&idle.info.server, -1);
        }
        Some(chosen)
    }

    /// Finds and reports incompatible servers: their simulator is not the run's, their description
    /// of the task differs from that of the run's first server, or the policy cannot act in their
    /// task.
    fn check_compatible(&self, state: &mut State, task: &TaskId, fleet: &Fleet) {
        state.incompatible.retain(|server, _| fleet.servers.contains_key(server));
        for (id, server) in &fleet.servers {
            let Some(offer) = offered(server, task) else { continue };
            let (expected, got) = (self.options.action_length, offer.action.len());
            let own = simulator(server);
            let reason = if got != expected {
                format!(
                    "task {task}: expected actions with {expected} dimensions, as in the policy, got {got}"
                )
            } else if let Some(expected) = state.simulator.as_ref().filter(|run| **run != own) {
                format!("expected the run's simulator ({expected}), got {own}")
            } else if let Some(difference) =
                state.tasks.get(task).and_then(|first| difference(first, offer))
            {
                format!("task {task}: {difference}")
            } else {
                continue;
            };
            if state.incompatible.get(id) != Some(&reason) {
                tracing::warn!("ignoring server {id}: {reason}");
                state.incompatible.insert(id.clone(), reason);
            }
        }
    }

    /// Opens a session in the background. The task holds only a weak reference to the pool, so that
    /// local servers end with the run even if another server has not replied yet.
    fn open(self: &Arc<Self>, chosen: Chosen, request: SessionRequest) {
        let open = Open {
            protocol: PROTOCOL_VERSION,
            task: request.task.task.clone(),
            variant: request.task.variant.clone(),
            image_height: self.options.image_size.0 as u32,
            image_width: self.options.image_size.1 as u32,
            expert: request.needs_expert,
            holder: self.options.holder.clone(),
        };
        let (network, pool) = (self.network.clone(), Arc::downgrade(self));
        tokio::spawn(async move {
            let opened = Environment::open(&network, &chosen.server, open).await;
            if let Some(pool) = pool.upgrade() {
                pool.note_opened(chosen, request, opened);
            }
        });
    }

    /// Adds the opened session to the idle ones, or records why there is none.
    fn note_opened(
        &self,
        chosen: Chosen,
        request: SessionRequest,
        opened: Result<Environment, EnvironmentFault>,
    ) {
        let Chosen { begun, server, simulator, task } = chosen;
        let mut state = self.state();
        let this = (begun, server.clone());
        if let Some(index) = state.opening.iter().position(|other| *other == this) {
            state.opening.swap_remove(index);
        }
        match opened {
            Ok(environment) => {
                let run = state.simulator.get_or_insert_with(|| simulator.clone()).clone();
                if run == simulator {
                    state.tasks.entry(request.task).or_insert_with(|| task.clone());
                    state.proven.insert(server.clone());
                    state.refusals.remove(&server);
                    let session =
                        Session { info: SessionInfo { server, simulator, task }, environment };
                    state.idle.push((session, request.needs_expert));
                } else {
                    // Another server was faster. This one is reported at the next compatibility
                    // check.
                    state.add(&server, -1);
                }
            }
            Err(fault) => {
                state.add(&server, -1);
                state.refusals.insert(server.clone(), format!("server {server}: {fault}"));
                match &fault {
                    EnvironmentFault::Refused { .. } => state.ask_later(&server),
                    _ => self.suspect(&mut state, &server, &fault),
                }
            }
        }
        drop(state);
        self.freed.notify_waiters();
    }

    /// Skips a server for a while (backoff); a local server that does not reply is killed and
    /// restarted.
    fn suspect(&self, state: &mut State, server: &str, fault: &EnvironmentFault) {
        let pause = state.backoff.get(server).map_or(BACKOFF, |backoff| backoff.pause * 2);
        let pause = pause.min(BACKOFF_MAX);
        tracing::warn!("{fault}; no new sessions on this server for {} s", pause.as_secs());
        state.pause(server, pause);
        state.proven.remove(server);
        state.idle.retain(|(session, _)| session.info.server != server);
        if let Some(local) = &self.local {
            local.replace(server);
        }
    }

    /// Fails if waiting is hopeless or has taken too long.
    fn check_patience(&self, request: &SessionRequest, fleet: &Fleet) -> Result<()> {
        if let Some(reason) = self.local.as_ref().and_then(|local| local.given_up()) {
            bail!("{reason}");
        }
        let mut state = self.state();
        if state.in_use.values().sum::<usize>() > state.idle.len() + state.opening.len() {
            state.idle_since = None;
            state.is_reported = false;
            return Ok(());
        }
        let waits = *state.idle_since.get_or_insert_with(Instant::now);
        if waits.elapsed() >= REPORT_AFTER && !std::mem::replace(&mut state.is_reported, true) {
            tracing::warn!(
                "waiting for a session of task {}: {}",
                request.task,
                state.reasons(fleet)
            );
        }
        let had_any = !state.proven.is_empty() || !state.backoff.is_empty();
        let all = fleet.servers.values();
        let mut offering = all.filter(|server| offered(server, &request.task).is_some());
        let is_hopeless = fleet.undescribed.is_empty()
            && offering.all(|server| state.incompatible.contains_key(&server.server))
            && !state.incompatible.is_empty();
        let patience = match (is_hopeless, had_any) {
            (true, _) => INCOMPATIBLE_WAIT,
            (false, true) => self.options.wait,
            (false, false) => self.options.first_wait,
        };
        if waits.elapsed() >= patience {
            bail!(
                "no session of task {} could be opened within {} s: {}",
                request.task,
                patience.as_secs(),
                state.reasons(fleet)
            );
        }
        Ok(())
    }
}

impl SessionPool for ZenohPool {
    type Environment = Environment;

    async fn acquire(&self, request: &SessionRequest) -> Result<Session<Environment>> {
        let pool = &self.0;
        let _waiting = Waiting::begin(pool);
        let mut changes = pool.fleet.clone();
        loop {
            let mut freed = pin!(pool.freed.notified());
            // From now on no notification is missed while the pool is checked.
            freed.as_mut().enable();
            let fleet = changes.borrow_and_update().clone();
            if let Some(session) = pool.idle(request, &fleet) {
                return Ok(session);
            }
            if let Some(chosen) = pool.reserve(request, &fleet) {
                pool.open(chosen, request.clone());
            }
            pool.check_patience(request, &fleet)?;
            // Wakes up even if nothing changes: backoffs and patience end at fixed times.
            let woken = async {
                tokio::select! {
                    () = freed => Ok(()),
                    changed = changes.changed() => changed,
                }
            };
            if let Ok(Err(_)) = tokio::time::timeout(REFUSED_PAUSE, woken).await {
                bail!("the network is closed");
            }
        }
    }

    fn release(&self, session: Session<Environment>) {
        let pool = &self.0;
        let mut state = pool.state();
        let server = session.info.server.clone();
        state.backoff.remove(&server);
        let fleet = pool.fleet.borrow();
        let in_use = |server: &String| state.in_use.get(server).copied().unwrap_or(0);
        let usable = fleet.servers.keys().filter(|id| !state.incompatible.contains_key(*id));
        let fewest = usable.map(in_use).min().unwrap_or(0);
        if in_use(&server) > fewest + 1 {
            // Another server has become available: the next session is opened there.
            state.add(&server, -1);
        } else {
            let has_expert = session.environment.has_expert();
            state.idle.push((session, has_expert));
        }
        drop(fleet);
        drop(state);
        pool.freed.notify_waiters();
    }

    fn lost(&self, info: &SessionInfo, fault: &EnvironmentFault) {
        let pool = &self.0;
        let mut state = pool.state();
        state.add(&info.server, -1);
        match fault {
            EnvironmentFault::TimedOut { .. } => pool.suspect(&mut state, &info.server, fault),
            EnvironmentFault::ServerLost { .. } | EnvironmentFault::LinkLost { .. } => {
                state.idle.retain(|(session, _)| session.info.server != info.server);
                if let Some(local) = &pool.local {
                    local.replace(&info.server);
                }
            }
            EnvironmentFault::Wire { .. } => pool.suspect(&mut state, &info.server, fault),
            EnvironmentFault::Refused { .. } | EnvironmentFault::Faulted { .. } => {}
        }
        drop(state);
        pool.freed.notify_waiters();
    }
}

/// An episode that waits for a session.
struct Waiting<'a>(&'a Pool);

impl Waiting<'_> {
    fn begin(pool: &Pool) -> Waiting<'_> {
        pool.state().waiting += 1;
        Waiting(pool)
    }
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.0.state().waiting -= 1;
    }
}
