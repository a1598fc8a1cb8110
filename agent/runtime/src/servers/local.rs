//! The servers started on this machine, as the rest of the program uses them.

use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};

use super::program::ServerProgram;
use super::supervisor::{Event, Supervisor};

/// Options for local servers.
#[derive(Debug, Clone)]
pub struct LocalServerOptions {
    /// Number of processes.
    pub count: usize,
    /// The zenoh endpoint that the servers connect to; it must already be listening.
    pub connect: String,
    /// The fleet that the servers join.
    pub fleet: String,
    /// Number of sessions of each process.
    pub sessions_each: usize,
    /// Maximum time without progress of a server's simulation; after it the server counts as
    /// frozen.
    pub silence_max: Duration,
}

/// Running servers; dropping this kills the processes.
#[derive(Debug)]
pub struct LocalServers {
    events: Sender<Event>,
    state: Arc<Mutex<State>>,
    supervisor: Option<JoinHandle<()>>,
}

impl LocalServers {
    /// Starts the servers and waits until they are ready. A server that ends before is restarted a
    /// limited number of times; it is an error if none becomes ready. Blocks the calling thread for
    /// seconds.
    ///
    /// `last_beat` returns when a server's simulation last made progress. A server without progress
    /// is killed and restarted.
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
        // This thread lives as long as the servers; a pool thread might end earlier and kill them.
        let supervisor = std::thread::Builder::new()
            .name("server supervisor".to_owned())
            .spawn(move || supervisor.run(&received))
            .context("cannot start the server supervisor thread")?;
        let servers = LocalServers { events, state, supervisor: Some(supervisor) };
        let answer = all_ready.recv().context("the server supervisor thread ended")?;
        answer.map(|()| servers)
    }

    /// The ids of the servers that are ready, as in the protocol's keys.
    pub fn server_ids(&self) -> Vec<String> {
        lock(&self.state).server_ids.clone()
    }

    /// The process ids of the running servers.
    pub fn process_ids(&self) -> Vec<u32> {
        lock(&self.state).process_ids.clone()
    }

    /// Number of restarts of servers.
    pub fn restarts(&self) -> u32 {
        lock(&self.state).restarts
    }

    /// Why no server is running any more, if that is so: each exceeded its number of restarts.
    pub fn given_up(&self) -> Option<String> {
        lock(&self.state).given_up.clone()
    }

    /// Kills a server that does not reply and starts another one in its place. Does nothing if no
    /// server with this id runs here.
    pub fn replace(&self, server_id: &str) {
        let _ = self.events.send(Event::Replace { server_id: server_id.to_owned() });
    }
}

impl Drop for LocalServers {
    fn drop(&mut self) {
        // The supervisor may already have ended; then its children have ended too.
        let _ = self.events.send(Event::Stop);
        if let Some(supervisor) = self.supervisor.take() {
            let _ = supervisor.join();
        }
    }
}

/// State for other threads, as of the last event.
#[derive(Debug, Default)]
pub(super) struct State {
    pub(super) server_ids: Vec<String>,
    pub(super) process_ids: Vec<u32>,
    pub(super) restarts: u32,
    pub(super) given_up: Option<String>,
}

/// After a panic in another thread the values are still valid.
pub(super) fn lock(state: &Mutex<State>) -> MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
