//! The queue of the simulation thread: bounded for each session and processed round-robin.
//!
//! zenoh's threads only add to it and never wait. A session that sends too much fills only its own
//! queue.

use std::collections::{HashMap, VecDeque};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use protocol::{CodecError, Request, codec};
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

/// Requests per session. A holder has one request at a time and repeats it if it is dropped.
const REQUESTS_MAX: usize = 4;
/// Queries of all agents together.
const QUERIES_MAX: usize = 64;

/// A unit of work.
pub enum Work {
    /// A query on `describe`.
    Describe(Query),
    /// A query on `open`.
    Open(Query),
    /// A session's request, or why its bytes were rejected.
    Request { session: String, bytes: Result<Vec<u8>, CodecError> },
}

/// Shared with zenoh's threads.
#[derive(Default)]
pub struct Inbox {
    waiting: Mutex<Waiting>,
    arrived: Condvar,
}

#[derive(Default)]
struct Waiting {
    queries: VecDeque<Work>,
    requests: HashMap<String, VecDeque<Result<Vec<u8>, CodecError>>>,
    /// Each source with waiting work, exactly once.
    turns: VecDeque<Source>,
}

enum Source {
    Queries,
    Session(String),
}

impl Inbox {
    /// Starts accepting the session's requests.
    pub fn admit(&self, session: &str) {
        self.waiting().requests.insert(session.to_owned(), VecDeque::new());
    }

    /// Stops accepting the session's requests.
    pub fn forget(&self, session: &str) {
        self.waiting().requests.remove(session);
    }

    /// Copies a request unless it is too large or the session's queue is full.
    pub fn put_request(&self, session: &str, payload: &ZBytes) {
        let waiting = &mut *self.waiting();
        let Some(requests) = waiting.requests.get_mut(session) else { return };
        if requests.len() >= REQUESTS_MAX {
            return;
        }
        let checked = codec::check_size::<Request>(payload.len());
        requests.push_back(checked.map(|()| payload.to_bytes().into_owned()));
        if requests.len() == 1 {
            waiting.turns.push_back(Source::Session(session.to_owned()));
        }
        self.arrived.notify_one();
    }

    /// Adds a query on `describe` or `open`; returns it if the queue is full.
    pub fn put_query(&self, work: Work) -> Option<Work> {
        let mut waiting = self.waiting();
        if waiting.queries.len() >= QUERIES_MAX {
            return Some(work);
        }
        waiting.queries.push_back(work);
        if waiting.queries.len() == 1 {
            waiting.turns.push_back(Source::Queries);
        }
        self.arrived.notify_one();
        None
    }

    /// The next unit of work, or `None` if there is none until `deadline`.
    pub fn take(&self, deadline: Instant) -> Option<Work> {
        let mut waiting = self.waiting();
        loop {
            if let Some(work) = waiting.next() {
                return Some(work);
            }
            let left = deadline.checked_duration_since(Instant::now())?;
            (waiting, _) =
                self.arrived.wait_timeout(waiting, left).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Waiting {
    fn next(&mut self) -> Option<Work> {
        loop {
            match self.turns.pop_front()? {
                Source::Queries => {
                    let work = self.queries.pop_front();
                    if !self.queries.is_empty() {
                        self.turns.push_back(Source::Queries);
                    }
                    return work;
                }
                Source::Session(session) => {
                    // A session that has ended has no queue.
                    let Some(requests) = self.requests.get_mut(&session) else { continue };
                    let Some(bytes) = requests.pop_front() else { continue };
                    if !requests.is_empty() {
                        self.turns.push_back(Source::Session(session.clone()));
                    }
                    return Some(Work::Request { session, bytes });
                }
            }
        }
    }
}
