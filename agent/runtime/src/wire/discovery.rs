//! Discovery of servers: which are alive, when each simulation last made progress, what each
//! offers.
//!
//! zenoh's callbacks update the status of every server, and a background task requests the
//! descriptions of new ones. No episode waits for this.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{anyhow, ensure};
use protocol::{Description, Heartbeat, Keys, Message, decode, transport};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep_until};
use zenoh::Session;
use zenoh::sample::{Sample, SampleKind};

use crate::fault::printable;

/// A server that does not reply to a query within this time is queried again: the first query may
/// arrive before routes are established.
const DESCRIBE_TIMEOUT: Duration = Duration::from_secs(2);
/// Initial delay before querying a server again; doubled after each failure.
const DESCRIBE_PAUSE: Duration = Duration::from_millis(500);
/// Maximum delay.
const DESCRIBE_PAUSE_MAX: Duration = Duration::from_secs(30);
/// A server's memory is reported when it exceeds this size, and whenever it has doubled since.
const RESIDENT_BYTES_REPORTED: u64 = 4 << 30;

/// The current status of one server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ServerStatus {
    /// Its liveliness token exists.
    pub alive: bool,
    /// How often the token has disappeared: earlier sessions ended with it.
    pub losses: u32,
    /// When its simulation last made progress.
    pub beaten_at: Option<Instant>,
}

/// The servers that are alive, by their ids.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Fleet {
    /// The servers whose descriptions are known.
    pub servers: BTreeMap<String, Description>,
    /// Why the others cannot be used.
    pub undescribed: BTreeMap<String, String>,
}

/// The servers of a fleet, kept up to date by zenoh's callbacks and a background task.
#[derive(Debug, Default)]
pub struct Discovery {
    status: Mutex<HashMap<String, Known>>,
    /// Tokens appeared or disappeared; heartbeats do not count.
    changed: watch::Sender<()>,
    fleet: watch::Sender<Fleet>,
}

#[derive(Debug)]
struct Known {
    status: watch::Sender<ServerStatus>,
    /// The memory size at which the next report is due.
    resident_bytes_reported: u64,
    /// Whether an unreadable heartbeat was reported.
    is_unreadable_reported: bool,
}

impl Discovery {
    /// Starts the discovery; it ends with the session.
    pub async fn watch(session: &Session, keys: &Keys) -> anyhow::Result<Arc<Self>> {
        let discovery = Arc::new(Self::default());
        let (watched, names) = (Arc::clone(&discovery), keys.clone());
        session
            .liveliness()
            .declare_subscriber(keys.servers())
            .history(true)
            .callback(move |sample| watched.on_token(&names, &sample))
            .background()
            .await
            .map_err(|error| anyhow!("cannot watch for servers: {}", transport::in_words(error)))?;
        let (watched, names) = (Arc::clone(&discovery), keys.clone());
        session
            .declare_subscriber(keys.heartbeats())
            .callback(move |sample| watched.on_heartbeat(&names, &sample))
            .background()
            .await
            .map_err(|error| anyhow!("cannot watch heartbeats: {}", transport::in_words(error)))?;
        let asked = Arc::clone(&discovery);
        tokio::spawn(asked.ask_new_servers(session.clone(), keys.clone()));
        Ok(discovery)
    }

    /// The status of one server, with updates.
    pub fn status(&self, server: &str) -> watch::Receiver<ServerStatus> {
        self.update(server, |_| false)
    }

    /// The servers that are alive, with updates.
    pub fn fleet(&self) -> watch::Receiver<Fleet> {
        self.fleet.subscribe()
    }

    /// Requests the description of every new server in parallel, each repeatedly until it replies.
    async fn ask_new_servers(self: Arc<Self>, session: Session, keys: Keys) {
        let mut changed = self.changed.subscribe();
        let mut asked = JoinSet::new();
        let mut asking: HashSet<String> = HashSet::new();
        let mut retries: HashMap<String, (Instant, Duration)> = HashMap::new();
        while !session.is_closed() {
            changed.mark_unchanged();
            let alive = self.alive();
            self.forget(|server| alive.contains(server));
            retries.retain(|server, _| alive.contains(server));
            let described = self.fleet.borrow().servers.clone();
            for server in &alive {
                let is_due = retries.get(server).is_none_or(|(due, _)| *due <= Instant::now());
                if is_due && !described.contains_key(server) && asking.insert(server.clone()) {
                    let (session, keys, server) = (session.clone(), keys.clone(), server.clone());
                    asked.spawn(
                        async move { (server.clone(), describe(session, keys, server).await) },
                    );
                }
            }
            let due = retries.iter().filter(|(server, _)| !asking.contains(*server));
            let due = due.map(|(_, (due, _))| *due).min();
            let again = due.unwrap_or_else(|| Instant::now() + DESCRIBE_PAUSE_MAX);
            tokio::select! {
                Some(answer) = asked.join_next(), if !asked.is_empty() => {
                    // A panic is a defect of ours and is reported by the panic hook.
                    let Ok((server, answer)) = answer else { continue };
                    asking.remove(&server);
                    self.note_answer(server, answer, &mut retries);
                }
                _ = changed.changed() => {}
                () = sleep_until(again) => {}
            }
        }
    }

    fn note_answer(
        &self,
        server: String,
        answer: anyhow::Result<Description>,
        retries: &mut HashMap<String, (Instant, Duration)>,
    ) {
        match answer {
            Ok(description) => {
                retries.remove(&server);
                self.fleet.send_modify(|fleet| {
                    fleet.undescribed.remove(&server);
                    fleet.servers.insert(server, description);
                });
            }
            Err(error) => {
                let pause = retries.get(&server).map_or(DESCRIBE_PAUSE, |(_, pause)| *pause * 2);
                let pause = pause.min(DESCRIBE_PAUSE_MAX);
                retries.insert(server.clone(), (Instant::now() + pause, pause));
                let reason = printable(&format!("{error:#}"));
                self.fleet.send_if_modified(|fleet| {
                    let is_new = fleet.undescribed.get(&server) != Some(&reason);
                    if is_new {
                        tracing::warn!("ignoring server {server}: {reason}");
                        fleet.undescribed.insert(server, reason);
                    }
                    is_new
                });
            }
        }
    }

    fn forget(&self, stays: impl Fn(&str) -> bool) {
        self.fleet.send_if_modified(|fleet| {
            let before = fleet.servers.len() + fleet.undescribed.len();
            fleet.servers.retain(|server, _| stays(server));
            fleet.undescribed.retain(|server, _| stays(server));
            fleet.servers.len() + fleet.undescribed.len() != before
        });
    }

    fn alive(&self) -> HashSet<String> {
        let known = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        known
            .iter()
            .filter(|(_, known)| known.status.borrow().alive)
            .map(|(server, _)| server.clone())
            .collect()
    }

    fn on_token(&self, keys: &Keys, sample: &Sample) {
        let Some(server) = keys.server_of(sample.key_expr().as_str()) else { return };
        let alive = sample.kind() == SampleKind::Put;
        if !alive {
            // Update the fleet before the status: code that reacts to the loss must not find the
            // server in the fleet.
            self.forget(|name| name != server);
        }
        self.update(server, |status| {
            status.losses += u32::from(status.alive && !alive);
            std::mem::replace(&mut status.alive, alive) != alive
        });
        self.changed.send_replace(());
    }

    fn on_heartbeat(&self, keys: &Keys, sample: &Sample) {
        let Some(server) = keys.server_of(sample.key_expr().as_str()) else { return };
        let bytes = sample.payload().len();
        let heartbeat = if bytes > Heartbeat::BYTES_MAX {
            Err(format!("heartbeat: expected at most {} bytes, got {bytes}", Heartbeat::BYTES_MAX))
        } else {
            decode::<Heartbeat>(&sample.payload().to_bytes()).map_err(|error| error.to_string())
        };
        match heartbeat {
            Ok(heartbeat) => {
                self.update(server, |status| {
                    status.beaten_at = Some(Instant::now());
                    true
                });
                self.report_memory(server, heartbeat.resident_bytes);
            }
            Err(reason) => self.report_unreadable(server, &reason),
        }
    }

    /// Reports once per server, because heartbeats come twice a second.
    fn report_unreadable(&self, server: &str, reason: &str) {
        let mut known = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        let known = known.entry(server.to_owned()).or_default();
        if !std::mem::replace(&mut known.is_unreadable_reported, true) {
            tracing::warn!("server {server}: {reason}");
        }
    }

    /// Reports a simulator that leaks memory before its machine runs out of memory.
    fn report_memory(&self, server: &str, resident_bytes: u64) {
        let mut known = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        let known = known.entry(server.to_owned()).or_default();
        if resident_bytes >= known.resident_bytes_reported {
            known.resident_bytes_reported = resident_bytes.saturating_mul(2);
            let gigabytes = resident_bytes as f64 / 1e9;
            tracing::warn!("server {server} uses {gigabytes:.1} GB of memory");
        }
    }

    /// Changes a server's status; `change` returns whether watchers must be notified.
    fn update(
        &self,
        server: &str,
        change: impl FnOnce(&mut ServerStatus) -> bool,
    ) -> watch::Receiver<ServerStatus> {
        let mut known = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        let known = known.entry(server.to_owned()).or_default();
        known.status.send_if_modified(change);
        known.status.subscribe()
    }
}

impl Default for Known {
    fn default() -> Self {
        Known {
            status: watch::Sender::default(),
            resident_bytes_reported: RESIDENT_BYTES_REPORTED,
            is_unreadable_reported: false,
        }
    }
}

/// Requests the description of one server.
pub(super) async fn describe(
    session: Session,
    keys: Keys,
    server: String,
) -> anyhow::Result<Description> {
    let replies =
        session.get(keys.describe(&server)?).timeout(DESCRIBE_TIMEOUT).await.map_err(|error| {
            anyhow!("cannot request its description: {}", transport::in_words(error))
        })?;
    let secs = DESCRIBE_TIMEOUT.as_secs();
    let silent = || anyhow!("no description within {secs} s");
    let reply = replies.recv_async().await.map_err(|_| silent())?;
    let sample = reply.result().map_err(|_| silent())?;
    let read = || -> anyhow::Result<Description> {
        protocol::codec::check_size::<Description>(sample.payload().len())?;
        let description: Description = decode(&sample.payload().to_bytes())?;
        let name = &description.server;
        ensure!(*name == server, "expected a description of server {server}, got one of {name}");
        Ok(description)
    };
    read().map_err(|error| anyhow!("invalid description: {error:#}"))
}
