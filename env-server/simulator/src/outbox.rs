//! Sends the server's messages from separate threads. zenoh makes a sender wait up to a minute for
//! a peer that stops reading, and neither the simulation nor other sessions may wait with it.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;

use anyhow::{Context, Result};
use bytes::Bytes;
use protocol::transport;
use zenoh::Wait;
use zenoh::pubsub::Publisher;
use zenoh::query::Query;

/// Maximum number of threads that answer queries; normally there is none.
const ANSWERING_MAX: usize = 64;
/// Limits of the queries that wait to be dropped without an answer: more than normal use produces
/// in the minute until zenoh closes the link of a peer that stopped reading.
const DISCARDED_MAX: usize = 16_384;
const DISCARDED_BYTES_MAX: usize = 32 << 20;

/// The replies of a session. Dropping it ends its thread after the last reply.
pub struct Outbox(Arc<Slot>);

#[derive(Default)]
struct Slot {
    next: Mutex<Next>,
    changed: Condvar,
}

#[derive(Default)]
struct Next {
    reply: Option<Bytes>,
    has_ended: bool,
}

impl Outbox {
    /// Starts the thread that sends with `publisher`.
    pub fn new(publisher: Publisher<'static>) -> Result<Outbox> {
        let slot = Arc::new(Slot::default());
        let sent = Arc::clone(&slot);
        let send = move || {
            while let Some(reply) = sent.wait() {
                if let Err(error) = publisher.put(reply).wait() {
                    tracing::warn!("cannot send a reply: {}", transport::in_words(error));
                }
            }
        };
        thread::Builder::new()
            .name("replies".to_owned())
            .spawn(send)
            .context("cannot start a thread")?;
        Ok(Outbox(slot))
    }

    /// Sends a reply, replacing one that is still waiting: its holder requests a missing reply
    /// again.
    pub fn send(&self, reply: Bytes) {
        self.0.next().reply = Some(reply);
        self.0.changed.notify_one();
    }
}

impl Drop for Outbox {
    fn drop(&mut self) {
        self.0.next().has_ended = true;
        self.0.changed.notify_one();
    }
}

impl Slot {
    /// The next reply; `None` after the last one.
    fn wait(&self) -> Option<Bytes> {
        let mut next = self.next();
        loop {
            if let Some(reply) = next.reply.take() {
                return Some(reply);
            }
            if next.has_ended {
                return None;
            }
            next = self.changed.wait(next).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn next(&self) -> MutexGuard<'_, Next> {
        self.next.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Answers queries. Dropping a query sends its end to the peer, which may also wait.
#[derive(Clone)]
pub struct Answers {
    answering: Arc<AtomicUsize>,
    discarded: SyncSender<Query>,
    discarded_bytes: Arc<AtomicUsize>,
}

impl Answers {
    /// Starts the thread that drops queries without an answer.
    pub fn new() -> Result<Answers> {
        let (discarded, queries) = sync_channel::<Query>(DISCARDED_MAX);
        let discarded_bytes = Arc::new(AtomicUsize::new(0));
        let held = Arc::clone(&discarded_bytes);
        let end_all = move || {
            for query in queries {
                let size = size(&query);
                drop(query);
                held.fetch_sub(size, Ordering::Relaxed);
            }
        };
        thread::Builder::new()
            .name("discarded".to_owned())
            .spawn(end_all)
            .context("cannot start a thread")?;
        Ok(Answers { answering: Arc::default(), discarded, discarded_bytes })
    }

    /// Answers in a separate thread; drops the query if too many answers are waiting for their
    /// readers.
    pub fn send(&self, query: Query, key: String, bytes: Vec<u8>) {
        if self.answering.fetch_add(1, Ordering::Relaxed) >= ANSWERING_MAX {
            self.answering.fetch_sub(1, Ordering::Relaxed);
            return self.discard(query);
        }
        let answering = Arc::clone(&self.answering);
        let answer = move || {
            if let Err(error) = query.reply(key, bytes).wait() {
                tracing::warn!("cannot answer a query: {}", transport::in_words(error));
            }
            drop(query);
            answering.fetch_sub(1, Ordering::Relaxed);
        };
        if let Err(error) = thread::Builder::new().name("answer".to_owned()).spawn(answer) {
            self.answering.fetch_sub(1, Ordering::Relaxed);
            tracing::warn!("cannot answer a query: cannot start a thread: {error}");
        }
    }

    /// Drops a query without an answer and without waiting.
    pub fn discard(&self, query: Query) {
        let size = size(&query);
        let held = self.discarded_bytes.fetch_add(size, Ordering::Relaxed);
        // Beyond these limits the query is dropped here and may wait for its peer.
        if held > DISCARDED_BYTES_MAX || self.discarded.try_send(query).is_err() {
            self.discarded_bytes.fetch_sub(size, Ordering::Relaxed);
        }
    }
}

/// Size of a query's payload in bytes.
pub fn size(query: &Query) -> usize {
    query.payload().map_or(0, |payload| payload.len())
}
