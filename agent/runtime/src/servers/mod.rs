//! Local environment servers: child processes, watched, started again, never outliving this one.

mod process;

use std::process::Command;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};

use self::process::ServerProcess;
use crate::simulator::ServerProgram;

/// Starting Python, MuJoCo and OpenGL takes 1 to 2 s; the rest is for machines under load.
const READY_TIMEOUT_SECS: u64 = 120;
/// How often one server is started again. One that keeps dying has a cause that this cannot cure.
const RESTARTS_MAX: u32 = 5;
/// One that worked for so long did not die of that cause.
const CURED_AFTER: Duration = Duration::from_secs(3600);

/// What to start.
#[derive(Debug, Clone)]
pub struct LocalServerOptions {
    /// How many processes.
    pub count: usize,
    /// The zenoh endpoint that they connect to; somebody must listen there already.
    pub connect: String,
    /// The fleet that they join.
    pub fleet: String,
    /// How many sessions each process serves.
    pub sessions_each: usize,
}

/// Running servers; dropping them kills the processes.
#[derive(Debug)]
pub struct LocalServers {
    events: Sender<Event>,
    state: Arc<Mutex<State>>,
    supervisor: Option<JoinHandle<()>>,
}

impl LocalServers {
    /// Starts the servers and waits until each says that it is ready. Blocks the calling thread for
    /// seconds.
    pub fn start(program: ServerProgram, options: &LocalServerOptions) -> Result<LocalServers> {
        let (events, received) = channel();
        let (ready, all_ready) = channel();
        let state = Arc::new(Mutex::new(State::default()));
        let supervisor = Supervisor {
            program,
            options: options.clone(),
            slots: (0..options.count).map(|_| Slot::default()).collect(),
            state: Arc::clone(&state),
            events: events.clone(),
            ready: Some(ready),
        };
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

    /// How often a server died and was started again.
    pub fn restarts(&self) -> u32 {
        lock(&self.state).restarts
    }

    /// Why a server was given up, if one was: it died more often than it may be started again.
    pub fn given_up(&self) -> Option<String> {
        lock(&self.state).given_up.clone()
    }

    /// Kills a server that no longer answers; it is started again like one that died.
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

#[derive(Debug)]
enum Event {
    /// A server printed a line on its standard output.
    Line { slot: usize, line: String },
    /// A server closed its standard output, which is to say that it died.
    Closed { slot: usize },
    /// Somebody found that a server lives without working.
    Replace { server_id: String },
    /// The servers are no longer needed.
    Stop,
}

/// What other threads may ask about, as of the last event.
#[derive(Debug, Default)]
struct State {
    server_ids: Vec<String>,
    process_ids: Vec<u32>,
    restarts: u32,
    given_up: Option<String>,
}

/// One place for a server, taken by one process after the other.
#[derive(Default)]
struct Slot {
    process: Option<ServerProcess>,
    server_id: Option<String>,
    ready_at: Option<Instant>,
    restarts: u32,
    /// Since it last worked for long.
    restarts_in_a_row: u32,
}

/// What the watching thread owns.
struct Supervisor {
    program: ServerProgram,
    options: LocalServerOptions,
    slots: Vec<Slot>,
    state: Arc<Mutex<State>>,
    events: Sender<Event>,
    /// Answered once: when all servers are ready, or the first one cannot be.
    ready: Option<Sender<Result<()>>>,
}

impl Supervisor {
    fn run(mut self, events: &Receiver<Event>) {
        let result = self.start().and_then(|()| self.watch(events));
        for process in self.slots.iter_mut().filter_map(|slot| slot.process.take()) {
            process.end();
        }
        if let (Err(error), Some(ready)) = (result, self.ready.take()) {
            // Whoever waited for the servers may have ended.
            let _ = ready.send(Err(error));
        }
    }

    fn start(&mut self) -> Result<()> {
        for slot in 0..self.slots.len() {
            self.slots[slot].process = Some(self.spawn(slot)?);
        }
        Ok(())
    }

    /// Returns when the servers are no longer needed. Fails only while they start: a server that
    /// never worked would not work the next time.
    fn watch(&mut self, events: &Receiver<Event>) -> Result<()> {
        let deadline = Instant::now() + Duration::from_secs(READY_TIMEOUT_SECS);
        loop {
            self.publish();
            let event = if self.ready.is_some() {
                events.recv_timeout(deadline.saturating_duration_since(Instant::now()))
            } else {
                events.recv().map_err(RecvTimeoutError::from)
            };
            match event {
                Ok(Event::Line { slot, line }) => self.on_line(slot, &line),
                Ok(Event::Closed { slot }) => self.on_closed(slot)?,
                Ok(Event::Replace { server_id }) => self.on_replace(&server_id),
                Ok(Event::Stop) | Err(RecvTimeoutError::Disconnected) => return Ok(()),
                Err(RecvTimeoutError::Timeout) => return Err(self.not_ready()),
            }
        }
    }

    fn publish(&self) {
        let mut state = lock(&self.state);
        state.server_ids = self.slots.iter().filter_map(|slot| slot.server_id.clone()).collect();
        let processes = self.slots.iter().filter_map(|slot| slot.process.as_ref());
        state.process_ids = processes.map(ServerProcess::id).collect();
        state.restarts = self.slots.iter().map(|slot| slot.restarts).sum();
    }

    fn on_line(&mut self, slot: usize, line: &str) {
        let Some(offer) = line.strip_prefix("ready ") else { return };
        let Some(server_id) = offer.split_whitespace().next() else { return };
        self.slots[slot].server_id = Some(server_id.to_owned());
        self.slots[slot].ready_at = Some(Instant::now());
        if self.slots.iter().all(|slot| slot.server_id.is_some())
            && let Some(ready) = self.ready.take()
        {
            self.publish();
            let _ = ready.send(Ok(()));
        }
    }

    fn on_closed(&mut self, slot: usize) -> Result<()> {
        let Some(process) = self.slots[slot].process.take() else { return Ok(()) };
        self.slots[slot].server_id = None;
        let ended = process.end();
        if self.ready.is_some() {
            bail!("a server did not start: {ended}");
        }
        let ready_at = self.slots[slot].ready_at.take();
        if ready_at.is_some_and(|ready| ready.elapsed() > CURED_AFTER) {
            self.slots[slot].restarts_in_a_row = 0;
        }
        if self.slots[slot].restarts_in_a_row == RESTARTS_MAX {
            let reason = format!("a server died {} times, at last: {ended}", RESTARTS_MAX + 1);
            tracing::warn!("{reason}; it is not started again");
            lock(&self.state).given_up = Some(reason);
            return Ok(());
        }
        tracing::warn!("a server died and is started again: {ended}");
        self.slots[slot].restarts += 1;
        self.slots[slot].restarts_in_a_row += 1;
        match self.spawn(slot) {
            Ok(process) => self.slots[slot].process = Some(process),
            Err(error) => lock(&self.state).given_up = Some(format!("{error:#}")),
        }
        Ok(())
    }

    /// Its standard output closes, and all else follows from that.
    fn on_replace(&mut self, server_id: &str) {
        let wanted = |slot: &&mut Slot| slot.server_id.as_deref() == Some(server_id);
        if let Some(process) =
            self.slots.iter_mut().find(wanted).and_then(|slot| slot.process.as_mut())
        {
            process.kill();
        }
    }

    fn spawn(&self, slot: usize) -> Result<ServerProcess> {
        let (parent, sessions) = (std::process::id(), self.options.sessions_each);
        let mut command: Command = self.program.command();
        command
            .arg("serve")
            .args(self.program.serve_arguments())
            .args(["--exit-with-parent", &parent.to_string()])
            .args(["--sessions", &sessions.to_string()])
            .args(["--connect", &self.options.connect, "--fleet", &self.options.fleet]);
        let lines = self.events.clone();
        let closed = self.events.clone();
        ServerProcess::spawn(
            &mut command,
            // The supervisor may have ended; then nobody needs to know.
            move |line| drop(lines.send(Event::Line { slot, line })),
            move || drop(closed.send(Event::Closed { slot })),
        )
    }

    fn not_ready(&self) -> anyhow::Error {
        let waiting = self.slots.iter().filter(|slot| slot.server_id.is_none());
        let words: Vec<String> =
            waiting.filter_map(|slot| Some(slot.process.as_ref()?.last_words())).collect();
        anyhow!(
            "{} of {} servers were not ready within {READY_TIMEOUT_SECS} s\n{}",
            words.len(),
            self.slots.len(),
            words.join("\n")
        )
    }
}

/// A thread that panicked while it held the lock leaves plain values behind, as good as before.
fn lock(state: &Mutex<State>) -> MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests;
