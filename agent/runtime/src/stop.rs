//! How a person ends a run early: Ctrl-C once to finish the running episodes, twice to drop them.

use anyhow::{Context, Result};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::watch;

/// How a run is asked to end early.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stop {
    /// It is not.
    No,
    /// Episodes that run are finished, no more are begun.
    Finish,
    /// Episodes that run are dropped; what is recorded stays.
    Now,
}

/// Watches for Ctrl-C, and for the signal that supervisors send, which allows little time: it stops at once.
pub fn listen() -> Result<watch::Receiver<Stop>> {
    let interrupts = signal(SignalKind::interrupt()).context("cannot listen for Ctrl-C")?;
    let terminations = signal(SignalKind::terminate()).context("cannot listen for SIGTERM")?;
    let (sender, receiver) = watch::channel(Stop::No);
    tokio::spawn(forward(interrupts, terminations, sender));
    Ok(receiver)
}

/// Waits until a run is asked to end this early or earlier; for ever where nobody can ask any more.
pub async fn asked(mut stop: watch::Receiver<Stop>, at_least: Stop) {
    if stop.wait_for(|stop| *stop >= at_least).await.is_err() {
        std::future::pending().await
    }
}

async fn forward(mut interrupts: Signal, mut terminations: Signal, stop: watch::Sender<Stop>) {
    while *stop.borrow() != Stop::Now {
        let next = tokio::select! {
            _ = interrupts.recv() => match *stop.borrow() {
                Stop::No => Stop::Finish,
                Stop::Finish | Stop::Now => Stop::Now,
            },
            _ = terminations.recv() => Stop::Now,
        };
        if next == Stop::Finish {
            eprintln!("finishing the episodes that are running; press Ctrl-C again to drop them");
        }
        stop.send_replace(next);
    }
}
