//! The thread that starts, watches and restarts local servers. No server outlives this process.

use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow};

use super::local::{LocalServerOptions, State, lock};
use super::process::ServerProcess;
use super::program::ServerProgram;

/// Starting Python, MuJoCo and OpenGL takes 1 to 2 s; the rest is a margin for loaded machines.
const READY_TIMEOUT: Duration = Duration::from_secs(120);
/// Maximum number of consecutive restarts of a server. A server that keeps ending has a cause that
/// restarting does not fix.
const RESTARTS_MAX: u32 = 5;
/// The same for a server that was never ready, because the run waits for it.
const FIRST_RESTARTS_MAX: u32 = 2;
/// After this time of normal operation the number of consecutive restarts is reset.
const CURED_AFTER: Duration = Duration::from_secs(300);
/// Interval of checking heartbeats.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// If a check is this late, this process itself was suspended and has missed heartbeats.
const LATE_LOOK: Duration = Duration::from_secs(5);
/// How long to wait for killed processes; they end at once unless they wait for a device.
const END_WAIT: Duration = Duration::from_secs(5);

/// When a server's simulation last made progress, if known.
pub(super) type LastBeat = Box<dyn Fn(&str) -> Option<Instant> + Send>;

#[derive(Debug)]
pub(super) enum Event {
    /// The server of a process is ready.
    Ready { start: u64, server_id: String },
    /// A process ended.
    Ended { start: u64 },
    /// A server does not work.
    Replace { server_id: String },
    /// The servers are no longer needed.
    Stop,
}

/// The slot of one server; its processes follow one another.
#[derive(Default)]
struct Slot {
    running: Option<Running>,
    ready: Option<Ready>,
    was_ever_ready: bool,
    restarts: u32,
    /// Restarts since it last worked for a long time.
    restarts_in_a_row: u32,
    /// Why it is not restarted.
    given_up: Option<String>,
}

struct Running {
    /// Distinguishes this process's events from those of earlier processes.
    start: u64,
    process: ServerProcess,
    started_at: Instant,
}

struct Ready {
    server_id: String,
    at: Instant,
    /// When its simulation last made progress.
    beat_at: Instant,
}

impl Slot {
    /// What is wrong with the server, if anything.
    fn complaint(&mut self, last_beat: &LastBeat, silence_max: Duration) -> Option<String> {
        let running = self.running.as_ref()?;
        if let Some(ready) = &mut self.ready {
            let beat = last_beat(&ready.server_id);
            ready.beat_at = beat.map_or(ready.beat_at, |beat| beat.max(ready.beat_at));
            let silence = ready.beat_at.elapsed();
            return (silence > silence_max).then(|| {
                format!("its simulation has made no progress for {} s", silence.as_secs())
            });
        }
        let is_late = running.started_at.elapsed() > READY_TIMEOUT;
        is_late.then(|| format!("it was not ready within {} s", READY_TIMEOUT.as_secs()))
    }

    /// Restarts the timeouts after this process was suspended.
    fn excuse(&mut self, now: Instant) {
        if let Some(running) = &mut self.running {
            running.started_at = now;
        }
        if let Some(ready) = &mut self.ready {
            ready.beat_at = now;
        }
    }
}

/// The state of the supervisor thread.
pub(super) struct Supervisor {
    program: ServerProgram,
    options: LocalServerOptions,
    slots: Vec<Slot>,
    /// Processes that were killed and have not ended yet.
    dying: Vec<Running>,
    starts: u64,
    state: Arc<Mutex<State>>,
    events: Sender<Event>,
    /// Receives one message when every server is ready or given up.
    ready: Option<Sender<Result<()>>>,
    last_beat: LastBeat,
    looked_at: Instant,
}

impl Supervisor {
    pub(super) fn new(
        program: ServerProgram,
        options: LocalServerOptions,
        last_beat: LastBeat,
        events: Sender<Event>,
        state: Arc<Mutex<State>>,
        ready: Sender<Result<()>>,
    ) -> Supervisor {
        Supervisor {
            program,
            slots: (0..options.count).map(|_| Slot::default()).collect(),
            options,
            dying: Vec::new(),
            starts: 0,
            state,
            events,
            ready: Some(ready),
            last_beat,
            looked_at: Instant::now(),
        }
    }

    pub(super) fn run(mut self, events: &Receiver<Event>) {
        for slot in 0..self.slots.len() {
            self.start(slot);
        }
        let deadline = Instant::now() + READY_TIMEOUT;
        while self.answer(Instant::now() >= deadline) {
            match events.recv_timeout(LOOK_EVERY) {
                Ok(Event::Ready { start, server_id }) => self.on_ready(start, server_id),
                Ok(Event::Ended { start }) => self.on_ended(start),
                Ok(Event::Replace { server_id }) => self.on_replace(&server_id),
                Ok(Event::Stop) | Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {}
            }
            self.look();
            self.publish();
        }
        self.end(events);
    }

    /// Reports once whether the servers have started; returns false if none has.
    fn answer(&mut self, is_late: bool) -> bool {
        let is_settled = |slot: &Slot| slot.ready.is_some() || slot.given_up.is_some();
        if self.ready.is_none() || !(is_late || self.slots.iter().all(is_settled)) {
            return true;
        }
        let is_any_ready =
            self.slots.is_empty() || self.slots.iter().any(|slot| slot.ready.is_some());
        self.publish();
        if let Some(ready) = self.ready.take() {
            let answer = if is_any_ready { Ok(()) } else { Err(self.not_ready()) };
            // The receiving thread may have ended.
            let _ = ready.send(answer);
        }
        is_any_ready
    }

    fn not_ready(&self) -> anyhow::Error {
        let mut reasons: Vec<String> = Vec::new();
        for slot in &self.slots {
            let running = slot.running.as_ref();
            let late = running.map(|running| running.process.last_words()).unwrap_or_default();
            let late = format!("not ready within {} s\n{late}", READY_TIMEOUT.as_secs());
            let reason = slot.given_up.clone().unwrap_or(late);
            if !reasons.contains(&reason) {
                reasons.push(reason);
            }
        }
        anyhow!("no environment server could be started: {}", reasons.join("\n"))
    }

    fn publish(&self) {
        let mut state = lock(&self.state);
        let ready = self.slots.iter().filter_map(|slot| slot.ready.as_ref());
        state.server_ids = ready.map(|ready| ready.server_id.clone()).collect();
        let running = self.slots.iter().filter_map(|slot| slot.running.as_ref());
        state.process_ids = running.map(|running| running.process.id()).collect();
        state.restarts = self.slots.iter().map(|slot| slot.restarts).sum();
        let given_up: Option<Vec<&String>> =
            self.slots.iter().map(|slot| slot.given_up.as_ref()).collect();
        state.given_up = given_up.and_then(|reasons| reasons.last().copied().cloned());
    }

    fn on_ready(&mut self, start: u64, server_id: String) {
        let Some(slot) = self.slot_of(start) else { return };
        let now = Instant::now();
        self.slots[slot].ready = Some(Ready { server_id, at: now, beat_at: now });
        self.slots[slot].was_ever_ready = true;
    }

    fn on_ended(&mut self, start: u64) {
        if let Some(index) = self.dying.iter().position(|running| running.start == start) {
            self.dying.swap_remove(index).process.end();
        } else if let Some(slot) = self.slot_of(start)
            && let Some(running) = self.slots[slot].running.take()
        {
            let reason = running.process.end();
            self.start_again(slot, &reason);
        }
    }

    fn on_replace(&mut self, server_id: &str) {
        let is_it =
            |slot: &Slot| slot.ready.as_ref().is_some_and(|ready| ready.server_id == server_id);
        if let Some(slot) = self.slots.iter().position(is_it) {
            self.replace(slot, "it did not reply");
        }
    }

    /// Kills servers that are not ready in time or whose simulation makes no progress.
    fn look(&mut self) {
        let was_stopped = self.looked_at.elapsed() > LATE_LOOK;
        self.looked_at = Instant::now();
        let silence_max = self.options.silence_max;
        for slot in 0..self.slots.len() {
            if was_stopped {
                self.slots[slot].excuse(self.looked_at);
            }
            if let Some(reason) = self.slots[slot].complaint(&self.last_beat, silence_max) {
                self.replace(slot, &reason);
            }
        }
    }

    /// Does not wait for the end of the process: one that waits for a device ends only when the
    /// device replies.
    fn replace(&mut self, slot: usize, reason: &str) {
        let Some(mut running) = self.slots[slot].running.take() else { return };
        running.process.kill();
        let reason = format!("{reason}\n{}", running.process.last_words());
        self.dying.push(running);
        self.start_again(slot, reason.trim_end());
    }

    fn start_again(&mut self, index: usize, reason: &str) {
        let slot = &mut self.slots[index];
        if slot.ready.take().is_some_and(|ready| ready.at.elapsed() > CURED_AFTER) {
            slot.restarts_in_a_row = 0;
        }
        let restarts_max = if slot.was_ever_ready { RESTARTS_MAX } else { FIRST_RESTARTS_MAX };
        if slot.restarts_in_a_row == restarts_max {
            let starts = restarts_max + 1;
            let reason = format!("a server ended {starts} times; last reason: {reason}");
            tracing::warn!("{reason}; it will not be restarted");
            slot.given_up = Some(reason);
            return;
        }
        tracing::warn!("restarting a server: {reason}");
        slot.restarts += 1;
        slot.restarts_in_a_row += 1;
        self.start(index);
    }

    fn start(&mut self, slot: usize) {
        self.starts += 1;
        match self.spawn(self.starts) {
            Ok(process) => {
                let started_at = Instant::now();
                let running = Running { start: self.starts, process, started_at };
                self.slots[slot].running = Some(running);
            }
            Err(error) => self.slots[slot].given_up = Some(format!("{error:#}")),
        }
    }

    fn spawn(&self, start: u64) -> Result<ServerProcess> {
        let (parent, sessions) = (std::process::id(), self.options.sessions_each);
        let mut command = self.program.command();
        command
            .arg("serve")
            .args(self.program.serve_arguments())
            .args(["--exit-with-parent", &parent.to_string()])
            .args(["--sessions", &sessions.to_string()])
            .args(["--connect", &self.options.connect, "--fleet", &self.options.fleet]);
        let (lines, ended) = (self.events.clone(), self.events.clone());
        // The supervisor may have ended when these events are sent.
        ServerProcess::spawn(
            &mut command,
            move |line| {
                // The id is followed by the tasks and the endpoint of the server.
                let offer = line.strip_prefix("ready ");
                if let Some(server_id) = offer.and_then(|offer| offer.split_whitespace().next()) {
                    drop(lines.send(Event::Ready { start, server_id: server_id.to_owned() }));
                }
            },
            move || drop(ended.send(Event::Ended { start })),
        )
    }

    fn slot_of(&self, start: u64) -> Option<usize> {
        let is_it = |slot: &Slot| slot.running.as_ref().is_some_and(|it| it.start == start);
        self.slots.iter().position(is_it)
    }

    fn end(mut self, events: &Receiver<Event>) {
        let running = self.slots.iter_mut().filter_map(|slot| slot.running.take());
        self.dying.extend(running);
        self.dying.iter_mut().for_each(|running| running.process.kill());
        let deadline = Instant::now() + END_WAIT;
        while !self.dying.is_empty() {
            match events.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(Event::Ended { start }) => self.on_ended(start),
                Ok(_) => {}
                Err(_) => break,
            }
        }
        for running in &self.dying {
            tracing::warn!("server process {} was killed but has not ended", running.process.id());
        }
    }
}
