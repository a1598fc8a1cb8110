//! Sessions over zenoh, all stepped by one thread, which owns the rendering contexts.
//!
//! callback -> inbox -> simulation thread -> session -> outbox. Neither zenoh's threads nor the
//! simulation thread wait for a peer.

use std::collections::{BTreeSet, HashMap};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Result, anyhow, ensure};
use protocol::{
    CodecError, Description, Heartbeat, Keys, Open, Opening, PROTOCOL_VERSION, TaskDescription,
    codec, decode, encode, limits,
};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::qos::{CongestionControl, Priority, Reliability};
use zenoh::query::{Query, Queryable};
use zenoh::sample::SampleKind;
use zenoh::{Session as Network, Wait};

use crate::inbox::{Inbox, Work};
use crate::outbox::{Answers, Outbox, size};
use crate::session::{Session, refused};
use crate::worlds::Worlds;

const BEAT: Duration = Duration::from_millis(500);
/// How long a session lives without its holder's token: the connection may be restored.
const HOLDER_WAIT_MAX: Duration = Duration::from_secs(10);
/// How long a closed session still answers, because its last reply may have been lost.
const CLOSED_WAIT_MAX: Duration = Duration::from_secs(10);

/// Options of a server.
#[derive(Debug, Clone)]
pub struct ServerOptions {
    /// Peers see each other only within the same fleet.
    pub fleet: String,
    /// Maximum number of concurrent sessions.
    pub sessions_max: u32,
}

/// A server that runs in the thread that calls `run`.
pub struct Server<'a> {
    id: String,
    network: &'a Network,
    worlds: Worlds,
    options: ServerOptions,
    keys: Keys,
    leases: HashMap<String, Lease>,
    ended_steps: u64,
    inbox: Arc<Inbox>,
    answers: Answers,
}

/// A session with its zenoh declarations.
struct Lease {
    opened_for: String,
    session: Session,
    opened_at: Instant,
    closed_at: Option<Instant>,
    /// Written by zenoh's threads.
    holder: Arc<Mutex<Holder>>,
    outbox: Outbox,
    _requests: Subscriber<()>,
    _token: Subscriber<()>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Holder {
    Awaited,
    Alive,
    Gone(Instant),
}

impl<'a> Server<'a> {
    pub fn new(network: &'a Network, worlds: Worlds, options: ServerOptions) -> Result<Server<'a>> {
        let keys = Keys::new(&options.fleet)?;
        let server = Server {
            id: fresh_id(),
            network,
            worlds,
            options,
            keys,
            leases: HashMap::new(),
            ended_steps: 0,
            inbox: Arc::default(),
            answers: Answers::new()?,
        };
        // Fail now if the description exceeds the protocol's limits.
        encode(&server.description())?;
        Ok(server)
    }

    /// Declares everything, the liveliness token last, and serves until `stop` is set.
    pub fn run(mut self, stop: &AtomicBool, ready: impl FnOnce(&str) -> Result<()>) -> Result<()> {
        let network = self.network;
        let _describe = self.queryable(self.keys.describe(&self.id)?, Work::Describe)?;
        let _open = self.queryable(self.keys.open(&self.id)?, Work::Open)?;
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
            if let Some(work) = self.inbox.take(beat_at) {
                self.perform(work)?;
            }
        }
        Ok(())
    }

    /// Passes queries on `key` to the simulation thread; refuses queries that are too large and
    /// drops those beyond the limit.
    fn queryable(&self, key: String, work: fn(Query) -> Work) -> Result<Queryable<()>> {
        let (inbox, answers) = (Arc::clone(&self.inbox), self.answers.clone());
        let of = key.clone();
        self.network
            .declare_queryable(key)
            .callback(move |query| {
                if let Err(error) = codec::check_size::<Open>(size(&query)) {
                    let refused = Opening::Refused { reason: error.to_string() };
                    let bytes = encode(&refused).expect("a reason within its limit can be encoded");
                    answers.send(query, of.clone(), bytes);
                } else if let Some(Work::Describe(query) | Work::Open(query)) =
                    inbox.put_query(work(query))
                {
                    answers.discard(query);
                }
            })
            .wait()
            .map_err(in_words)
    }

    fn perform(&mut self, work: Work) -> Result<()> {
        match work {
            Work::Describe(query) => {
                let bytes = encode(&self.description())?;
                self.answers.send(query, self.keys.describe(&self.id)?, bytes);
            }
            Work::Open(query) => {
                let bytes = encode(&self.open(&query))?;
                self.answers.send(query, self.keys.open(&self.id)?, bytes);
            }
            Work::Request { session, bytes } => self.answer(&session, bytes),
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

    /// Opens a session. Its subscribers are declared before this returns.
    fn lease(&mut self, query: &Query) -> Result<String> {
        let bytes = query.payload().map(|payload| payload.to_bytes()).unwrap_or_default();
        let opened: Open = decode(&bytes)?;
        let sessions_max = self.options.sessions_max;
        let holders: BTreeSet<&str> =
            self.leases.values().map(|lease| &*lease.opened_for).collect();
        ensure!(
            self.sessions() < sessions_max,
            "all {sessions_max} sessions are in use, by {}",
            Vec::from_iter(holders).join(", ")
        );
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
        let outbox = Outbox::new(publisher)?;
        self.inbox.admit(&name);
        let (inbox, of) = (Arc::clone(&self.inbox), name.clone());
        let requests = self
            .network
            .declare_subscriber(self.keys.request(&name)?)
            .callback(move |sample| inbox.put_request(&of, sample.payload()))
            .wait()
            .map_err(in_words)?;
        let seen = Arc::new(Mutex::new(Holder::Awaited));
        let token = self.watch(&name, Arc::clone(&seen))?;
        let lease = Lease {
            opened_for: holder.clone(),
            session,
            opened_at: Instant::now(),
            closed_at: None,
            holder: seen,
            outbox,
            _requests: requests,
            _token: token,
        };
        self.leases.insert(name.clone(), lease);
        tracing::info!("session {name} opened for {holder}");
        Ok(name)
    }

    /// Watches the liveliness token of the session's holder.
    fn watch(&self, name: &str, seen: Arc<Mutex<Holder>>) -> Result<Subscriber<()>> {
        self.network
            .liveliness()
            .declare_subscriber(self.keys.session(name)?)
            .history(true)
            .callback(move |sample| {
                let mut holder = locked(&seen);
                *holder = match (sample.kind(), *holder) {
                    (SampleKind::Put, _) => Holder::Alive,
                    (SampleKind::Delete, Holder::Alive) => Holder::Gone(Instant::now()),
                    (SampleKind::Delete, before) => before,
                };
            })
            .wait()
            .map_err(in_words)
    }

    fn answer(&mut self, name: &str, bytes: Result<Vec<u8>, CodecError>) {
        let Some(lease) = self.leases.get_mut(name) else { return };
        let reply = match bytes {
            Ok(bytes) => lease.session.answer(&bytes, &mut self.worlds),
            Err(error) => Some(refused(0, &error.to_string())),
        };
        if lease.session.closed && lease.closed_at.is_none() {
            lease.closed_at = Some(Instant::now());
        }
        if let Some(reply) = reply {
            lease.outbox.send(reply);
        }
    }

    fn end_abandoned(&mut self, now: Instant) {
        let since = |then: Instant| now.saturating_duration_since(then);
        let mut ended = Vec::new();
        for (name, lease) in &self.leases {
            let holder = *locked(&lease.holder);
            if let Some(closed_at) = lease.closed_at {
                if since(closed_at) > CLOSED_WAIT_MAX || matches!(holder, Holder::Gone(_)) {
                    ended.push((name.clone(), None));
                }
            } else if let Holder::Gone(gone_at) = holder {
                if since(gone_at) > HOLDER_WAIT_MAX {
                    let seconds = HOLDER_WAIT_MAX.as_secs();
                    let reason = format!("its client has been gone for {seconds} s");
                    ended.push((name.clone(), Some(reason)));
                }
            } else if holder == Holder::Awaited && since(lease.opened_at) > HOLDER_WAIT_MAX {
                let seconds = HOLDER_WAIT_MAX.as_secs();
                let reason =
                    format!("its client's liveliness token did not appear within {seconds} s");
                ended.push((name.clone(), Some(reason)));
            }
        }
        for (name, reason) in ended {
            self.end(&name, reason.as_deref());
        }
    }

    fn end(&mut self, name: &str, reason: Option<&str>) {
        let Some(mut lease) = self.leases.remove(name) else { return };
        self.inbox.forget(name);
        self.ended_steps += lease.session.steps;
        if let Some(reason) = reason {
            tracing::info!("session {name} ended: {reason}");
            lease.outbox.send(refused(0, &format!("session {name} ended: {reason}")));
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

    /// Number of sessions in use.
    fn sessions(&self) -> u32 {
        self.leases.values().filter(|lease| !lease.session.closed).count() as u32
    }
}

/// A panic cannot leave the value inconsistent.
fn locked(holder: &Mutex<Holder>) -> MutexGuard<'_, Holder> {
    holder.lock().unwrap_or_else(PoisonError::into_inner)
}

fn fresh_id() -> String {
    format!("{:016x}", rand::random::<u64>())
}

fn in_words(error: zenoh::Error) -> anyhow::Error {
    anyhow!("zenoh: {}", protocol::transport::in_words(error))
}

/// Resident memory of this process; 0 if the system does not report it.
fn resident_bytes() -> u64 {
    let Ok(text) = std::fs::read_to_string("/proc/self/statm") else { return 0 };
    let pages: u64 =
        text.split_whitespace().nth(1).and_then(|word| word.parse().ok()).unwrap_or_default();
    // SAFETY: sysconf only returns a value.
    pages * unsafe { libc::sysconf(libc::_SC_PAGESIZE) } as u64
}
