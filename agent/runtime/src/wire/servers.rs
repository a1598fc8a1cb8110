//! The servers that a network sees: who lives, when each simulation last moved, what each offers.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{anyhow, ensure};
use protocol::{Description, Heartbeat, Keys, Message, decode};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, timeout_at};
use zenoh::Session;
use zenoh::sample::{Sample, SampleKind};

/// A description is asked for again after this long: the first query may be faster than routing.
const DESCRIBE_TIMEOUT: Duration = Duration::from_secs(2);

/// What is known of one server at a moment.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Sign {
    /// Its liveliness token stands.
    pub alive: bool,
    /// How often the token has gone: a session of before is gone with it.
    pub losses: u32,
    /// When its simulation last moved.
    pub beaten_at: Option<Instant>,
}

/// Kept up to date by zenoh's callbacks.
#[derive(Debug, Default)]
pub struct Servers {
    signs: Mutex<HashMap<String, watch::Sender<Sign>>>,
    /// Told of tokens that come and go, not of heartbeats.
    changed: watch::Sender<()>,
}

impl Servers {
    /// Starts to watch; the session's end ends it.
    pub async fn watch(session: &Session, keys: &Keys) -> anyhow::Result<Arc<Self>> {
        let servers = Arc::new(Self::default());
        let (watched, names) = (Arc::clone(&servers), keys.clone());
        session
            .liveliness()
            .declare_subscriber(keys.servers())
            .history(true)
            .callback(move |sample| watched.on_token(&names, &sample))
            .background()
            .await
            .map_err(|error| anyhow!("cannot watch for servers: {error}"))?;
        let (watched, names) = (Arc::clone(&servers), keys.clone());
        session
            .declare_subscriber(keys.heartbeats())
            .callback(move |sample| watched.on_heartbeat(&names, &sample))
            .background()
            .await
            .map_err(|error| anyhow!("cannot watch heartbeats: {error}"))?;
        Ok(servers)
    }

    /// The signs of one server from now on.
    pub fn signs(&self, server: &str) -> watch::Receiver<Sign> {
        self.update(server, |_| false)
    }

    /// Descriptions of at least `count` live servers, or of those that there are after `wait`.
    pub async fn described(
        &self,
        session: &Session,
        keys: &Keys,
        count: usize,
        wait: Duration,
    ) -> Vec<Description> {
        let deadline = Instant::now() + wait;
        let mut changed = self.changed.subscribe();
        let mut described: BTreeMap<String, Description> = BTreeMap::new();
        loop {
            changed.mark_unchanged();
            let alive = self.alive();
            described.retain(|server, _| alive.contains(server));
            let mut asked = JoinSet::new();
            for server in alive.iter().filter(|server| !described.contains_key(*server)) {
                asked.spawn(describe(session.clone(), keys.clone(), server.clone()));
            }
            // One that does not answer must not hide the others.
            while let Ok(Some(answer)) = timeout_at(deadline, asked.join_next()).await {
                match answer.map_err(anyhow::Error::from).flatten() {
                    Ok(description) => {
                        drop(described.insert(description.server.clone(), description))
                    }
                    Err(error) => tracing::debug!(%error, "a server did not describe itself"),
                }
            }
            let complete = described.len() >= count && described.len() == alive.len();
            if complete || Instant::now() >= deadline {
                return described.into_values().collect();
            }
            // A server that did not answer is asked again even when nothing changes.
            let again = deadline.min(Instant::now() + DESCRIBE_TIMEOUT);
            let _ = timeout_at(again, changed.changed()).await;
        }
    }

    fn alive(&self) -> Vec<String> {
        let signs = self.signs.lock().unwrap_or_else(PoisonError::into_inner);
        signs
            .iter()
            .filter(|(_, sign)| sign.borrow().alive)
            .map(|(server, _)| server.clone())
            .collect()
    }

    fn on_token(&self, keys: &Keys, sample: &Sample) {
        let Some(server) = keys.server_of(sample.key_expr().as_str()) else { return };
        let alive = sample.kind() == SampleKind::Put;
        self.update(server, |sign| {
            sign.losses += u32::from(sign.alive && !alive);
            std::mem::replace(&mut sign.alive, alive) != alive
        });
        self.changed.send_replace(());
    }

    fn on_heartbeat(&self, keys: &Keys, sample: &Sample) {
        let Some(server) = keys.server_of(sample.key_expr().as_str()) else { return };
        if sample.payload().len() > Heartbeat::BYTES_MAX {
            return tracing::warn!(
                server,
                bytes = sample.payload().len(),
                "a heartbeat is too large"
            );
        }
        match decode::<Heartbeat>(&sample.payload().to_bytes()) {
            Ok(_) => drop(self.update(server, |sign| {
                sign.beaten_at = Some(Instant::now());
                true
            })),
            Err(error) => tracing::warn!(server, %error, "a heartbeat cannot be read"),
        }
    }

    /// Changes a server's signs; `change` says whether watchers need to look.
    fn update(
        &self,
        server: &str,
        change: impl FnOnce(&mut Sign) -> bool,
    ) -> watch::Receiver<Sign> {
        let mut signs = self.signs.lock().unwrap_or_else(PoisonError::into_inner);
        let sign =
            signs.entry(server.to_owned()).or_insert_with(|| watch::Sender::new(Sign::default()));
        sign.send_if_modified(change);
        sign.subscribe()
    }
}

pub(super) async fn describe(
    session: Session,
    keys: Keys,
    server: String,
) -> anyhow::Result<Description> {
    let replies = session
        .get(keys.describe(&server)?)
        .timeout(DESCRIBE_TIMEOUT)
        .await
        .map_err(|error| anyhow!("cannot ask server {server}: {error}"))?;
    let reply =
        replies.recv_async().await.map_err(|_| anyhow!("server {server} did not answer"))?;
    let sample = reply.result().map_err(|error| anyhow!("server {server} answered {error}"))?;
    protocol::codec::check_size::<Description>(sample.payload().len())?;
    let description: Description = decode(&sample.payload().to_bytes())?;
    let name = &description.server;
    ensure!(*name == server, "expected a description of server {server}, got one of {name}");
    Ok(description)
}
