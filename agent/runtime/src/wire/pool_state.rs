//! The state of a pool: the sessions of its run and the servers that it asks for them.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use decision::TaskId;
use protocol::TaskDescription;
use tokio::time::Instant;

use super::Environment;
use super::discovery::Fleet;
use crate::session::Session;

/// Delay before asking again a server that refused, usually because it is full.
pub const REFUSED_PAUSE: Duration = Duration::from_secs(1);
/// Until a server has opened a session, an opening that takes longer than this is not counted on:
/// another server is asked as well.
const OPENING_USUAL: Duration = Duration::from_secs(5);
/// Initial backoff of a server that did not reply; doubled after each failure.
pub const BACKOFF: Duration = Duration::from_secs(30);
/// Maximum backoff.
pub const BACKOFF_MAX: Duration = Duration::from_secs(600);

/// The sessions and servers of a run.
#[derive(Default)]
pub struct State {
    /// The simulator and its version; all episodes of a run use the same one.
    pub simulator: Option<String>,
    /// The description of each task by the first server that opened a session of it.
    pub tasks: BTreeMap<TaskId, TaskDescription>,
    /// Sessions without an episode, and whether their observations include the expert's action.
    pub idle: Vec<(Session<Environment>, bool)>,
    /// Number of this run's sessions per server, including those that are being opened.
    pub in_use: BTreeMap<String, usize>,
    /// Sessions that are being opened: start time and server.
    pub opening: Vec<(Instant, String)>,
    /// Number of episodes that wait for a session.
    pub waiting: usize,
    /// Servers that have opened a session.
    pub proven: BTreeSet<String>,
    /// Servers that are skipped for a while.
    pub backoff: BTreeMap<String, Backoff>,
    /// Servers that cannot serve this run, with the reasons; each is reported once.
    pub incompatible: BTreeMap<String, String>,
    /// The last reason of each server that gave no session.
    pub refusals: BTreeMap<String, String>,
    /// When this run last became idle, without any session in use.
    pub idle_since: Option<Instant>,
    /// Whether the reason for waiting was reported.
    pub is_reported: bool,
}

/// A server that is skipped for a while.
pub struct Backoff {
    pub until: Instant,
    pub pause: Duration,
}

impl State {
    /// Whether the sessions that are being opened suffice for the waiting episodes.
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

    /// For a server that replied but has no free session.
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
        if reasons.is_empty() {
            "no environment server found".to_owned()
        } else {
            reasons.join("; ")
        }
    }
}
