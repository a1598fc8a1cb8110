//! The servers that were started on this machine, as the rest of the program sees them.

use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};

use super::program::ServerProgram;
use super::supervisor::{Event, Supervisor};

/// What to start.
#[derive(Debug, Clone)]
pub struct LocalServerOptions {
    /// How many processes.
    pub count: usize,
    /// The zenoh endpoint that they connect to; it must be listened on already.
    pub connect: String,
    /// The fleet that they join.
    pub fleet: String,
    /// How many sessions each process serves.
    pub sessions_each: usize,
    /// A server whose simulation does not move for so long is frozen.
    pub silence_max: Duration,
}

/// Running servers; dropping them kills the processes.
#[derive(Debug)]
pub struct LocalServers {
    events: Sender<Event>,
    state: Arc<Mutex<State>>,
    supervisor: Option<JoinHandle<()>>,
}

impl LocalServers {
    /// Starts the servers and waits until each says that it is ready. One that dies before is started again within limits;
    /// an error when none becomes ready. Blocks the calling thread for seconds.
    ///
    /// `last_beat` tells when a server's simulation last moved; one whose does not is killed and started again.
    pub fn start(
        program: ServerProgram,
        options: &LocalServerOptions,
        last_beat: impl Fn(&str) -> Option<Instant> + Send + 'static,
    ) -> Result<LocalServers> {
        let (events, received) = channel();
        let (ready, all_ready) = channel();
        let state = Arc::new(Mutex::new(State::default()));
        let supervisor = Supervisor::new(
            program,
            options.clone(),
            Box::new(last_beat),
            events.clone(),
            Arc::clone(&state),
            ready,
        );
        // The kernel ties the death signal to the THREAD that started a child, not to its process.
        // This thread lives as long as the servers do; a thread of a pool might end earlier and
        // take them with it.
        let supervisor = std::thread::Builder::new()
            .name("server supervisor".to_owned())
            .spawn(move || supervisor.run(&received))
            .context("cannot start the thread that watches the servers")?;
        let servers = LocalServers { events, state, supervisor: Some(supervisor) };
        let answer = all_ready.recv().context("the thread that watches the servers ended")?;
        answer.map(|()| servers)
    }

    /// The ids of the servers that are ready now, as they stand in the protocol's keys.
    pub fn server_ids(&self) -> Vec<String> {
        lock(&self.state).server_ids.clone()
    }

    /// The process ids of the servers that run now.
    pub fn process_ids(&self) -> Vec<u32> {
        lock(&self.state).process_ids.clone()
    }

    /// How often a server was started again.
    pub fn restarts(&self) -> u32 {
        lock(&self.state).restarts
    }

    /// Why no server runs any more, if none does: each died more often than it may be started again.
    pub fn given_up(&self) -> Option<String> {
        lock(&self.state).given_up.clone()
    }

    /// Kills a server that does not answer; another is started in its place, as when it died. Nothing happens when no server
    /// of this id runs here.
    pub fn replace(&self, server_id: &str) {
        let _ = self.events.send(Event::Replace { server_id: server_id.to_owned() });
    }
}

impl Drop for LocalServers {
    fn drop(&mut self) {
        // The supervisor may be gone already; then its children are, too.
        let _ = self.events.send(Event::Stop);
        if let Some(supervisor) = self.supervisor.take() {
            let _ = supervisor.join();
        }
    }
}

/// What other threads may ask about, as of the last event.
#[derive(Debug, Default)]
pub(super) struct State {
    pub(super) server_ids: Vec<String>,
    pub(super) process_ids: Vec<u32>,
    pub(super) restarts: u32,
    pub(super) given_up: Option<String>,
}

/// A thread that panicked while it held the lock leaves plain values behind, as good as before.
pub(super) fn lock(state: &Mutex<State>) -> MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
