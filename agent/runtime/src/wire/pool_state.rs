//! What a pool knows of the sessions of its run and of the servers that it asks for them.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use decision::TaskId;
use protocol::TaskDescription;
use tokio::time::Instant;

use super::Environment;
use super::discovery::Fleet;
use crate::session::Session;

/// A server that refused, most often because it is full, is asked again after this long.
pub const REFUSED_PAUSE: Duration = Duration::from_secs(1);
/// Until a server has opened one session, an opening that takes longer is no longer counted on: another server is asked, too.
const OPENING_USUAL: Duration = Duration::from_secs(5);
/// The first time for which a server that did not answer is left out, doubled each time.
pub const BACKOFF: Duration = Duration::from_secs(30);
/// The longest such time.
pub const BACKOFF_MAX: Duration = Duration::from_secs(600);

/// What is known of a run's sessions.
#[derive(Default)]
pub struct State {
    /// All episodes of a run happen in one simulator of one version.
    pub simulator: Option<String>,
    /// Tasks as the first server that opened a session of them describes them.
    pub tasks: BTreeMap<TaskId, TaskDescription>,
    /// Sessions without an episode, and whether their observations carry the expert's action.
    pub idle: Vec<(Session<Environment>, bool)>,
    /// Sessions of this run by server, those that are being opened included.
    pub in_use: BTreeMap<String, usize>,
    /// Those of them that are being opened: since when, and on which server.
    pub opening: Vec<(Instant, String)>,
    /// Episodes that wait for a session.
    pub waiting: usize,
    /// Servers that have opened a session.
    pub proven: BTreeSet<String>,
    /// Servers that are left out, until when.
    pub backoff: BTreeMap<String, Backoff>,
    /// Why a server cannot serve this run at all; reported once.
    pub incompatible: BTreeMap<String, String>,
    /// What servers said last when they gave no session.
    pub refusals: BTreeMap<String, String>,
    /// Since when this run has had no session.
    pub idle_since: Option<Instant>,
    /// Whether it was said what it waits for.
    pub is_waiting_told: bool,
}

/// A server that is left out for a while.
pub struct Backoff {
    pub until: Instant,
    pub pause: Duration,
}

impl State {
    /// Whether the sessions that are being opened will do for the episodes that wait.
    pub fn is_enough_opening(&self) -> bool {
        let is_counted_on = |(begun, server): &&(Instant, String)| {
            self.proven.contains(server) || begun.elapsed() < OPENING_USUAL
        };
        self.opening.iter().filter(is_counted_on).count() >= self.waiting
    }

    pub fn add(&mut self, server: &str, more: isize) {
        let count = self.in_use.entry(server.to_owned()).or_default();
        *count = count.saturating_add_signed(more);
    }

    pub fn pause(&mut self, server: &str, pause: Duration) {
        let backoff = Backoff { until: Instant::now() + pause, pause };
        self.backoff.insert(server.to_owned(), backoff);
    }

    /// For a server that answered, and has no room.
    pub fn ask_later(&mut self, server: &str) {
        let until = Instant::now() + REFUSED_PAUSE;
        let backoff = self.backoff.entry(server.to_owned());
        backoff.or_insert(Backoff { until, pause: BACKOFF / 2 }).until = until;
    }

    /// Why there is no session.
    pub fn reasons(&self, fleet: &Fleet) -> String {
        let mut reasons: Vec<String> = self.refusals.values().cloned().collect();
        let described = |all: &BTreeMap<String, String>| -> Vec<String> {
            all.iter().map(|(server, reason)| format!("server {server}: {reason}")).collect()
        };
        reasons.extend(described(&self.incompatible));
        reasons.extend(described(&fleet.undescribed));
        if reasons.is_empty() { "no server is alive".to_owned() } else { reasons.join("; ") }
    }
}
