//! An unreliable network: a relay between two fleets that loses, repeats and delays messages.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::runtime::Handle;
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::Query;
use zenoh::sample::{Sample, SampleKind};

/// How unreliable the relay is; shares are in parts per thousand.
#[derive(Clone, Copy)]
pub struct Badness {
    /// Messages that are lost.
    pub dropped: u64,
    /// Messages that are sent twice.
    pub doubled: u64,
    /// Maximum delay in milliseconds. Each copy has its own delay, so that they overtake each
    /// other.
    pub delay_ms_max: u64,
}

/// What the relay has done so far.
#[derive(Default)]
pub struct Deeds {
    pub dropped: AtomicUsize,
    pub doubled: AtomicUsize,
    pub overtaken: AtomicUsize,
}

/// Relays requests from the fleet `agents` to the fleet `servers`, and replies in the opposite
/// direction.
pub struct Relay {
    session: Session,
    wire: Arc<Wire>,
}

struct Wire {
    session: Session,
    runtime: Handle,
    badness: Badness,
    random: Mutex<u64>,
    deeds: Deeds,
    /// Relays only liveliness, as if the simulation were stuck.
    stuck: AtomicBool,
    /// Number of messages sent, and the last one that arrived.
    sent: AtomicUsize,
    arrived: AtomicUsize,
    tokens: Mutex<HashMap<String, LivelinessToken>>,
}

impl Relay {
    /// Listens on `endpoint`, to which agents and servers connect.
    pub async fn start(endpoint: &str, seed: u64, badness: Badness) -> Self {
        let mut configuration = zenoh::Config::default();
        let endpoints = format!("[\"{endpoint}\"]");
        for (key, value) in [
            ("mode", "\"peer\""),
            ("listen/endpoints", &endpoints),
            ("scouting/multicast/enabled", "false"),
            ("scouting/gossip/enabled", "false"),
        ] {
            configuration.insert_json5(key, value).expect("zenoh has this option");
        }
        let session = zenoh::open(configuration).await.expect("the relay listens");
        let wire = Arc::new(Wire {
            session: session.clone(),
            runtime: Handle::current(),
            badness,
            random: Mutex::new(seed),
            deeds: Deeds::default(),
            stuck: AtomicBool::new(false),
            sent: AtomicUsize::new(0),
            arrived: AtomicUsize::new(0),
            tokens: Mutex::default(),
        });
        wire.carry("rever/3/agents/session/*/request", true).await;
        wire.carry("rever/3/servers/session/*/reply", true).await;
        wire.carry("rever/3/servers/server/*/heartbeat", false).await;
        wire.mirror("rever/3/servers/server/*").await;
        wire.mirror("rever/3/agents/session/*").await;
        wire.ask("rever/3/agents/server/*/*").await;
        Self { session, wire }
    }

    pub fn deeds(&self) -> &Deeds {
        &self.wire.deeds
    }

    /// From now on relays only liveliness.
    pub fn get_stuck(&self) {
        self.wire.stuck.store(true, Ordering::SeqCst);
    }

    pub async fn close(self) {
        self.session.close().await.expect("the relay closes");
    }
}

impl Wire {
    async fn carry(self: &Arc<Self>, keys: &str, badly: bool) {
        let wire = Arc::clone(self);
        let on_sample = move |sample: Sample| wire.on_sample(&sample, badly);
        self.session
            .declare_subscriber(keys.to_owned())
            .callback(on_sample)
            .background()
            .await
            .expect("a subscriber");
    }

    async fn mirror(self: &Arc<Self>, keys: &str) {
        let wire = Arc::clone(self);
        let on_token = move |sample: Sample| {
            let (wire, key, kind) =
                (Arc::clone(&wire), other_side(sample.key_expr()), sample.kind());
            wire.runtime.clone().spawn(async move {
                if kind == SampleKind::Put {
                    let token =
                        wire.session.liveliness().declare_token(&key).await.expect("a token");
                    lock(&wire.tokens).insert(key, token);
                } else {
                    let token = lock(&wire.tokens).remove(&key);
                    drop(token);
                }
            });
        };
        let liveliness = self.session.liveliness();
        liveliness
            .declare_subscriber(keys)
            .history(true)
            .callback(on_token)
            .background()
            .await
            .expect("a subscriber");
    }

    async fn ask(self: &Arc<Self>, keys: &str) {
        let wire = Arc::clone(self);
        let on_query = move |query: Query| {
            let wire = Arc::clone(&wire);
            wire.runtime.clone().spawn(async move {
                let payload = query.payload().cloned().unwrap_or_default();
                let asked = wire.session.get(other_side(query.key_expr())).payload(payload);
                let replies = asked.timeout(Duration::from_secs(30)).await.expect("a query");
                if let Ok(Ok(sample)) = replies.recv_async().await.map(|reply| reply.into_result())
                {
                    let key = other_side(sample.key_expr());
                    query.reply(key, sample.payload().clone()).await.expect("a reply");
                }
            });
        };
        self.session
            .declare_queryable(keys.to_owned())
            .callback(on_query)
            .background()
            .await
            .expect("a queryable");
    }

    fn on_sample(self: &Arc<Self>, sample: &Sample, badly: bool) {
        if self.stuck.load(Ordering::SeqCst) {
            return;
        }
        let Badness { dropped, doubled, delay_ms_max } = self.badness;
        let mut copies = 1;
        if badly && self.draw(1000) < dropped {
            self.deeds.dropped.fetch_add(1, Ordering::SeqCst);
            copies = 0;
        } else if badly && self.draw(1000) < doubled {
            self.deeds.doubled.fetch_add(1, Ordering::SeqCst);
            copies = 2;
        }
        for _ in 0..copies {
            let delay = Duration::from_millis(if badly { self.draw(delay_ms_max + 1) } else { 0 });
            let (wire, key, payload) =
                (Arc::clone(self), other_side(sample.key_expr()), sample.payload().clone());
            let number = self.sent.fetch_add(1, Ordering::SeqCst);
            self.runtime.spawn(async move {
                #[expect(clippy::disallowed_methods, reason = "the delay is what this wire does")]
                tokio::time::sleep(delay).await;
                if wire.arrived.fetch_max(number, Ordering::SeqCst) > number {
                    wire.deeds.overtaken.fetch_add(1, Ordering::SeqCst);
                }
                // The relay may already be closed when late copies are sent.
                let _ = wire.session.put(key, payload).await;
            });
        }
    }

    /// SplitMix64: a number below `end`.
    fn draw(&self, end: u64) -> u64 {
        let mut state = lock(&self.random);
        *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut bits = *state;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (bits ^ (bits >> 31)) % end
    }
}

fn other_side(key: &str) -> String {
    let [version, fleet, rest] = key.splitn(4, '/').skip(1).collect::<Vec<_>>()[..] else {
        panic!("unexpected key {key}")
    };
    let other = if fleet == "agents" { "servers" } else { "agents" };
    format!("rever/{version}/{other}/{rest}")
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
