//! Sessions over zenoh, all stepped by one thread: the one that owns the rendering contexts.
//!
//! zenoh's threads only enqueue: callback -> bounded queue -> simulation thread -> session -> reply.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow, ensure};
use bytes::Bytes;
use protocol::{
    Description, Heartbeat, Keys, Open, Opening, PROTOCOL_VERSION, Request, TaskDescription, codec,
    decode, encode, limits,
};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority, Reliability};
use zenoh::query::Query;
use zenoh::sample::SampleKind;
use zenoh::{Session as Network, Wait};

use crate::session::{Session, refused};
use crate::worlds::Worlds;

const BEAT: Duration = Duration::from_millis(500);
/// From opening a session to its holder's token.
const HOLDER_WAIT_MAX: Duration = Duration::from_secs(10);
/// A closed session still answers: its last reply may have been lost.
const CLOSED_WAIT_MAX: Duration = Duration::from_secs(10);
/// Requests waiting in the queue; the holder resends what is dropped.
const PENDING_PER_SESSION_MAX: usize = 4;

/// What a server offers.
#[derive(Debug, Clone)]
pub struct ServerOptions {
    /// Who meets whom.
    pub fleet: String,
    /// At once.
    pub sessions_max: u32,
}

/// Serves in the thread that calls `run`.
pub struct Server<'a> {
    id: String,
    network: &'a Network,
    worlds: Worlds,
    options: ServerOptions,
    keys: Keys,
    leases: HashMap<String, Lease>,
    ended_steps: u64,
    work: Receiver<Work>,
    enqueue: SyncSender<Work>,
}

/// What zenoh's threads leave to the simulation thread.
enum Work {
    Describe(Query),
    Open(Query),
    Request {
        session: String,
        bytes: zenoh::bytes::ZBytes,
    },
    /// A holder is gone.
    Look,
}

/// A session with what zenoh holds for it.
struct Lease {
    session: Session,
    opened_at: Instant,
    signs: Arc<Mutex<Signs>>,
    publisher: Publisher<'static>,
    _requests: Subscriber<()>,
    _holder: Subscriber<()>,
}

/// What zenoh's threads write at once: a simulation thread that was busy for long must not take what
/// waits in its queue for silence.
#[derive(Clone, Copy)]
struct Signs {
    used_at: Instant,
    holder: Holder,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Holder {
    Awaited,
    Alive,
    Gone,
}

impl<'a> Server<'a> {
    pub fn new(network: &'a Network, worlds: Worlds, options: ServerOptions) -> Result<Server<'a>> {
        let sessions_max = options.sessions_max;
        ensure!(
            (1..=limits::SESSIONS_MAX).contains(&sessions_max),
            "sessions: expected 1 to {}, got {sessions_max}",
            limits::SESSIONS_MAX
        );
        let keys = Keys::new(&options.fleet)?;
        let (enqueue, work) = sync_channel((sessions_max as usize + 1) * PENDING_PER_SESSION_MAX);
        let server = Server {
            id: fresh_id(),
            network,
            worlds,
            options,
            keys,
            leases: HashMap::new(),
            ended_steps: 0,
            work,
            enqueue,
        };
        // What cannot be described is refused now.
        encode(&server.description())?;
        Ok(server)
    }

    /// Declares everything, the liveliness token last; then works until `stop` is set.
    pub fn run(mut self, stop: &AtomicBool, ready: impl FnOnce(&str) -> Result<()>) -> Result<()> {
        let network = self.network;
        let enqueue = self.enqueuing();
        let _describe = network
            .declare_queryable(self.keys.describe(&self.id)?)
            .callback(move |query| enqueue(Work::Describe(query)))
            .wait()
            .map_err(in_words)?;
        let enqueue = self.enqueuing();
        let _open = network
            .declare_queryable(self.keys.open(&self.id)?)
            .callback(move |query| enqueue(Work::Open(query)))
            .wait()
            .map_err(in_words)?;
        let heartbeat = network
            .declare_publisher(self.keys.heartbeat(&self.id)?)
            .congestion_control(CongestionControl::Drop)
            .priority(Priority::InteractiveHigh)
            .wait()
            .map_err(in_words)?;
        let _token: LivelinessToken = network
            .liveliness()
            .declare_token(self.keys.server(&self.id)?)
            .wait()
            .map_err(in_words)?;
        ready(&self.id)?;
        let mut beat_at = Instant::now();
        while !stop.load(Ordering::Relaxed) {
            let now = Instant::now();
            if now >= beat_at {
                heartbeat.put(encode(&self.heartbeat())?).wait().map_err(in_words)?;
                self.end_abandoned(now);
                beat_at = now + BEAT;
            }
            match self.work.recv_timeout(beat_at.saturating_duration_since(now)) {
                Ok(work) => self.perform(work)?,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => {
                    unreachable!("the server itself holds a sender")
                }
            }
        }
        Ok(())
    }

    /// Leaves work to the simulation thread and drops what is too much.
    fn enqueuing(&self) -> impl Fn(Work) + Send + Sync + 'static {
        let sender = self.enqueue.clone();
        move |work| {
            if sender.try_send(work).is_err() {
                tracing::warn!("more is asked than the queue of requests holds");
            }
        }
    }

    fn perform(&mut self, work: Work) -> Result<()> {
        match work {
            Work::Describe(query) => {
                let bytes = encode(&self.description())?;
                answer(&query, &self.keys.describe(&self.id)?, bytes);
            }
            Work::Open(query) => {
                let opening = self.open(&query);
                answer(&query, &self.keys.open(&self.id)?, encode(&opening)?);
            }
            Work::Request { session, bytes } => self.answer(&session, &bytes),
            Work::Look => self.end_abandoned(Instant::now()),
        }
        Ok(())
    }

    fn description(&self) -> Description {
        let tasks = self.worlds.tasks().iter().map(|task| TaskDescription {
            task: task.id.task.clone(),
            variant: task.id.variant.clone(),
            version: task.rule.version,
            instruction: task.rule.instruction.clone(),
            steps_max: task.rule.steps_max,
            control_hz: Some(task.settings.control_hz() as f32),
            layouts: task.rule.grid.layouts.len() as u32,
            state: task.state.clone(),
            action: task.action.clone(),
        });
        Description {
            protocol: PROTOCOL_VERSION,
            server: self.id.clone(),
            simulator: "rever-simulator".to_owned(),
            simulator_version: format!(
                "{} mujoco {}",
                env!("CARGO_PKG_VERSION"),
                mujoco_rs::mujoco_version()
            ),
            tasks: tasks.collect(),
            image_side_max: limits::IMAGE_SIDE_MAX as u32,
            sessions: self.sessions(),
            sessions_max: self.options.sessions_max,
            slots_max: limits::SLOTS_MAX,
        }
    }

    fn open(&mut self, query: &Query) -> Opening {
        match self.lease(query) {
            Ok(session) => Opening::Opened { session },
            Err(error) => {
                let reason = format!("{error:#}");
                let end = reason.floor_char_boundary(200);
                Opening::Refused { reason: reason[..end].to_owned() }
            }
        }
    }

    /// A new session; everything that hears its requests stands when this returns.
    fn lease(&mut self, query: &Query) -> Result<String> {
        let payload = query.payload();
        let size = payload.map_or(0, |payload| payload.len());
        codec::check_size::<Open>(size)?;
        let bytes = payload.map(|payload| payload.to_bytes()).unwrap_or_default();
        let opened: Open = decode(&bytes)?;
        let sessions_max = self.options.sessions_max;
        ensure!(self.sessions() < sessions_max, "all {sessions_max} sessions are in use");
        let holder = opened.holder.clone();
        let session = Session::new(opened, &mut self.worlds)?;
        let name = fresh_id();
        let publisher = self
            .network
            .declare_publisher(self.keys.reply(&name)?)
            .congestion_control(CongestionControl::Block)
            .reliability(Reliability::Reliable)
            .express(true)
            .wait()
            .map_err(in_words)?;
        let now = Instant::now();
        let signs = Arc::new(Mutex::new(Signs { used_at: now, holder: Holder::Awaited }));
        let (enqueue, of, seen) = (self.enqueuing(), name.clone(), Arc::clone(&signs));
        let requests = self
            .network
            .declare_subscriber(self.keys.request(&name)?)
            .callback(move |sample| {
                locked(&seen).used_at = Instant::now();
                enqueue(Work::Request { session: of.clone(), bytes: sample.payload().clone() });
            })
            .wait()
            .map_err(in_words)?;
        let (enqueue, seen) = (self.enqueuing(), Arc::clone(&signs));
        let holder_token = self
            .network
            .liveliness()
            .declare_subscriber(self.keys.session(&name)?)
            .history(true)
            .callback(move |sample| {
                let mut signs = locked(&seen);
                signs.holder = match (sample.kind(), signs.holder) {
                    (SampleKind::Put, _) => Holder::Alive,
                    (SampleKind::Delete, Holder::Alive) => Holder::Gone,
                    (SampleKind::Delete, before) => before,
                };
                if signs.holder == Holder::Gone {
                    // At once, or with the next heartbeat if the queue is full.
                    enqueue(Work::Look);
                }
            })
            .wait()
            .map_err(in_words)?;
        let lease = Lease {
            session,
            opened_at: now,
            signs,
            publisher,
            _requests: requests,
            _holder: holder_token,
        };
        self.leases.insert(name.clone(), lease);
        tracing::info!("session {name} opened for {holder}");
        Ok(name)
    }

    fn answer(&mut self, name: &str, bytes: &zenoh::bytes::ZBytes) {
        let Some(lease) = self.leases.get_mut(name) else { return };
        let reply = match codec::check_size::<Request>(bytes.len()) {
            Ok(()) => lease.session.answer(&bytes.to_bytes(), &mut self.worlds),
            Err(error) => Some(refused(0, &error.to_string())),
        };
        if let Some(reply) = reply {
            publish(&lease.publisher, reply);
        }
        // However long that took, its holder was not the silent one.
        locked(&lease.signs).used_at = Instant::now();
    }

    fn end_abandoned(&mut self, now: Instant) {
        let mut ended = Vec::new();
        for (name, lease) in &self.leases {
            let Signs { used_at, holder } = *locked(&lease.signs);
            let idle = now.saturating_duration_since(used_at);
            if lease.session.closed && idle > CLOSED_WAIT_MAX {
                ended.push((name.clone(), None));
            } else if holder == Holder::Gone {
                ended.push((name.clone(), Some("its holder is gone".to_owned())));
            } else if holder == Holder::Awaited
                && now.saturating_duration_since(lease.opened_at) > HOLDER_WAIT_MAX
            {
                let seconds = HOLDER_WAIT_MAX.as_secs();
                let reason = format!("expected its holder's token within {seconds} s");
                ended.push((name.clone(), Some(reason)));
            }
        }
        for (name, reason) in ended {
            self.end(&name, reason.as_deref());
        }
    }

    fn end(&mut self, name: &str, reason: Option<&str>) {
        let Some(mut lease) = self.leases.remove(name) else { return };
        self.ended_steps += lease.session.steps;
        if let Some(reason) = reason {
            tracing::info!("session {name} ended: {reason}");
            publish(&lease.publisher, refused(0, &format!("session {name} ended: {reason}")));
        }
        lease.session.end(&mut self.worlds);
    }

    fn heartbeat(&self) -> Heartbeat {
        let steps: u64 = self.leases.values().map(|lease| lease.session.steps).sum();
        Heartbeat {
            server: self.id.clone(),
            sessions: self.sessions(),
            steps: self.ended_steps + steps,
            resident_bytes: resident_bytes(),
        }
    }

    /// Sessions in use.
    fn sessions(&self) -> u32 {
        self.leases.values().filter(|lease| !lease.session.closed).count() as u32
    }
}

/// Nothing that holds it can leave it half written.
fn locked(signs: &Mutex<Signs>) -> MutexGuard<'_, Signs> {
    signs.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A reply that cannot be sent is asked for again, or its holder is gone.
fn publish(publisher: &Publisher<'_>, bytes: Bytes) {
    if let Err(error) = publisher.put(bytes).wait() {
        tracing::warn!("a reply was not sent: {error}");
    }
}

/// Whoever asked may be gone.
fn answer(query: &Query, key: &str, bytes: Vec<u8>) {
    if let Err(error) = query.reply(key, bytes).wait() {
        tracing::warn!("a query was not answered: {error}");
    }
}

fn fresh_id() -> String {
    format!("{:016x}", rand::random::<u64>())
}

fn in_words(error: zenoh::Error) -> anyhow::Error {
    anyhow!("zenoh: {error}")
}

/// Memory that this process holds; 0 where the system does not tell.
fn resident_bytes() -> u64 {
    let Ok(text) = std::fs::read_to_string("/proc/self/statm") else { return 0 };
    let pages: u64 =
        text.split_whitespace().nth(1).and_then(|word| word.parse().ok()).unwrap_or_default();
    // SAFETY: a plain question to the system.
    pages * unsafe { libc::sysconf(libc::_SC_PAGESIZE) } as u64
}
