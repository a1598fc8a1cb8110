//! Stopping a run early: press Ctrl-C once to finish the running episodes, twice to discard them.

use anyhow::{Context, Result};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::watch;

/// How a run should end early.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stop {
    /// It continues.
    No,
    /// Running episodes are finished, no new ones are started.
    Finish,
    /// Running episodes are discarded; records are kept.
    Now,
}

/// Listens for Ctrl-C and for SIGTERM. SIGTERM stops at once, because supervisors allow little
/// time.
pub fn listen() -> Result<watch::Receiver<Stop>> {
    let interrupts = signal(SignalKind::interrupt()).context("cannot listen for Ctrl-C")?;
    let terminations = signal(SignalKind::terminate()).context("cannot listen for SIGTERM")?;
    let (sender, receiver) = watch::channel(Stop::No);
    tokio::spawn(forward(interrupts, terminations, sender));
    Ok(receiver)
}

/// Waits until a stop of at least this urgency is requested; waits forever if nothing can request
/// one any more.
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
            eprintln!("finishing the running episodes; press Ctrl-C again to discard them");
        }
        stop.send_replace(next);
    }
}
