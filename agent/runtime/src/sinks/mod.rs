//! Event sinks: record and report a run on their own thread.
//!
//! Rollouts emit events and continue. Writing records, labels and videos blocks only this thread;
//! only an episode that has ended waits until its record is durable.

mod outcomes;
mod progress;
mod store;
mod video;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use ::store::record::EpisodeRecord;
use ::store::run::FaultRecord;
use anyhow::{Context, Error, Result, anyhow, bail, ensure};
use protocol::Image;
use tokio::sync::{mpsc, oneshot};

pub use outcomes::OutcomeSink;
pub use progress::{Counts, Progress};
pub use store::StoreSink;
pub use video::VideoSink;

/// Maximum number of queued events. An event with a frame has up to 150 kB at 224 pixels.
const WAITING_MAX: usize = 256;

/// An event of a run.
#[derive(Debug, Clone)]
pub enum Event {
    /// An episode was reset.
    Started {
        /// Its name within the run.
        id: String,
        /// The observed image, if videos are recorded.
        image: Option<Image>,
    },
    /// One control step was executed.
    Stepped {
        /// The episode's name within the run.
        id: String,
        /// The observed image, if videos are recorded.
        image: Option<Image>,
    },
    /// An episode ended.
    Recorded(Box<EpisodeRecord>),
    /// An attempt failed.
    Faulted(FaultRecord),
    /// A message for the user.
    Notice(String),
}

/// Receives all events in order. May block.
pub trait EventSink: Send {
    /// Handles one event. An error ends the run.
    fn on(&mut self, event: &Event) -> Result<()>;

    /// Called after the last event.
    fn finish(&mut self) -> Result<()> {
        Ok(())
    }
}

/// The sinks of a run on their own thread.
pub struct Sinks {
    events: mpsc::Sender<Message>,
    failure: Arc<Mutex<Option<String>>>,
    thread: JoinHandle<()>,
}

struct Message {
    event: Event,
    /// Notified when every sink has handled the event.
    taken: Option<oneshot::Sender<()>>,
}

impl Sinks {
    /// Starts the thread; every event goes to the sinks in this order.
    pub fn start(sinks: Vec<Box<dyn EventSink>>) -> Result<Sinks> {
        let (events, received) = mpsc::channel(WAITING_MAX);
        let failure = Arc::new(Mutex::new(None));
        let failed = Arc::clone(&failure);
        let run = move || drain(sinks, received, &failed);
        let thread = std::thread::Builder::new()
            .name("event sinks".to_owned())
            .spawn(run)
            .context("cannot start the thread of the event sinks")?;
        Ok(Sinks { events, failure, thread })
    }

    /// Sends an event. An error is that of a sink that failed on this or an earlier event.
    pub async fn emit(&self, event: Event) -> Result<()> {
        let sent = self.events.send(Message { event, taken: None }).await;
        sent.map_err(|_| self.failed())
    }

    /// Sends an episode's record and waits until it is durable.
    pub async fn record(&self, record: EpisodeRecord) -> Result<()> {
        let (taken, handled) = oneshot::channel();
        let event = Event::Recorded(Box::new(record));
        let sent = self.events.send(Message { event, taken: Some(taken) }).await;
        sent.map_err(|_| self.failed())?;
        handled.await.map_err(|_| self.failed())
    }

    /// Waits until all events are handled.
    pub async fn finish(self) -> Result<()> {
        let Sinks { events, failure, thread } = self;
        drop(events);
        let joined = tokio::task::spawn_blocking(move || thread.join()).await;
        let joined = joined.context("cannot wait for the event sinks")?;
        ensure!(joined.is_ok(), "an event sink panicked");
        match lock(&failure).take() {
            Some(reason) => bail!(reason),
            None => Ok(()),
        }
    }

    /// The error that ended the thread.
    fn failed(&self) -> Error {
        let reason = lock(&self.failure).clone();
        anyhow!(reason.unwrap_or_else(|| "an event sink failed".to_owned()))
    }
}

/// Stores a failure before the channels close, so that a caller that finds them closed can read the
/// reason.
fn drain(
    mut sinks: Vec<Box<dyn EventSink>>,
    mut received: mpsc::Receiver<Message>,
    failure: &Mutex<Option<String>>,
) {
    let note = |error: Error| *lock(failure) = Some(format!("{error:#}"));
    while let Some(Message { event, taken }) = received.blocking_recv() {
        if let Err(error) = sinks.iter_mut().try_for_each(|sink| sink.on(&event)) {
            return note(error);
        }
        if let Some(taken) = taken {
            // The episode may have been dropped in the meantime; its record is kept anyway.
            let _ = taken.send(());
        }
    }
    if let Err(error) = sinks.iter_mut().try_for_each(|sink| sink.finish()) {
        note(error);
    }
}

fn lock(failure: &Mutex<Option<String>>) -> MutexGuard<'_, Option<String>> {
    failure.lock().unwrap_or_else(PoisonError::into_inner)
}
