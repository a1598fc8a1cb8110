//! Live progress with an estimate: a bar in a terminal, plain lines elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use anyhow::Result;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use tokio::sync::watch;

use super::{Event, EventSink};

/// How often a plain line is printed where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// What a run has done since it was started.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Control steps of all episodes.
    pub steps: u64,
    /// Recorded episodes.
    pub episodes: u64,
}

/// How far a run has come. Episodes that were recorded before this start count as done, but not for the estimate.
pub struct Progress {
    bar: Option<ProgressBar>,
    total: u64,
    done: u64,
    successes: u64,
    counts: watch::Sender<Counts>,
    /// Steps of the episodes that were recorded since the start.
    steps_recorded: u64,
    faults: u64,
    running: usize,
    started: Instant,
    printed: Instant,
}

impl Progress {
    /// `done` of `total` episodes are recorded already, `successes` of them successful.
    pub fn new(title: &str, total: u64, done: u64, successes: u64) -> Progress {
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("{prefix} {bar:30} {pos}/{len} {msg}");
            let bar =
                ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr_with_hz(4));
            bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
                .with_prefix(title.to_owned())
        });
        if bar.is_none() {
            eprintln!("{title}: {done} of {total} episodes recorded");
        }
        let now = Instant::now();
        Progress {
            bar,
            total,
            done,
            successes,
            counts: watch::Sender::default(),
            steps_recorded: 0,
            faults: 0,
            running: 0,
            started: now,
            printed: now,
        }
    }

    /// Counters for throughput measurement.
    pub fn counts(&self) -> watch::Receiver<Counts> {
        self.counts.subscribe()
    }

    /// One control step of one episode is over.
    fn stepped(&mut self) {
        self.counts.send_modify(|counts| counts.steps += 1);
        self.show();
    }

    /// An episode of so many steps is recorded.
    fn recorded(&mut self, is_success: bool, steps: usize) {
        self.done += 1;
        self.counts.send_modify(|counts| counts.episodes += 1);
        self.steps_recorded += steps as u64;
        self.successes += u64::from(is_success);
        self.show();
    }

    /// An attempt broke.
    fn faulted(&mut self, reason: &str) {
        self.faults += 1;
        self.say(&format!("fault: {reason}"));
    }

    /// Prints a line without breaking the bar.
    fn say(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{line}")),
            None => eprintln!("{line}"),
        }
    }

    /// Leaves the last state on the screen.
    fn leave(&self) {
        let line = self.line(self.started.elapsed());
        match &self.bar {
            Some(bar) => bar.abandon_with_message(line),
            None => eprintln!("{}/{} {line}", self.done, self.total),
        }
    }

    fn show(&mut self) {
        if let Some(bar) = &self.bar {
            bar.set_position(self.done);
            bar.set_message(self.line(self.started.elapsed()));
        } else if self.printed.elapsed() >= LINE_EVERY {
            self.printed = Instant::now();
            eprintln!("{}/{} {}", self.done, self.total, self.line(self.started.elapsed()));
        }
    }

    fn line(&self, elapsed: Duration) -> String {
        let secs = elapsed.as_secs_f64().max(1e-3);
        let Counts { steps, episodes: here } = *self.counts.borrow();
        let mut parts = Vec::new();
        if self.done > 0 {
            parts
                .push(format!("success {:.0} %", 100.0 * self.successes as f64 / self.done as f64));
        }
        parts.push(format!("{:.1} steps/s", steps as f64 / secs));
        if self.faults > 0 {
            parts.push(format!("{} faults", self.faults));
        }
        // Counted in steps: episodes that began together end together, so their own rate comes in waves.
        if here > 0 && self.done < self.total {
            let steps_expected =
                (self.total - self.done) as f64 * self.steps_recorded as f64 / here as f64;
            let steps_ahead = (steps - self.steps_recorded) as f64;
            let left = (steps_expected - steps_ahead).max(0.0) * secs / steps.max(1) as f64;
            parts.push(format!("{} left", clock(left)));
        } else if self.done < self.total {
            parts.push(format!("{} running", self.running));
        } else {
            parts.push(format!("in {}", clock(secs)));
        }
        parts.join(", ")
    }
}

impl EventSink for Progress {
    fn on(&mut self, event: &Event) -> Result<()> {
        match event {
            Event::Started { .. } => self.running += 1,
            Event::Stepped { .. } => self.stepped(),
            Event::Recorded(record) => {
                self.running = self.running.saturating_sub(1);
                self.recorded(
                    record.has_outcome() && record.statistics.is_success,
                    record.steps.len(),
                );
            }
            Event::Faulted(fault) => {
                self.running = self.running.saturating_sub(1);
                let id = fault.identity.id();
                self.faulted(&format!("{id} (attempt {}): {}", fault.attempt, fault.reason));
            }
            Event::Notice(line) => self.say(line),
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<()> {
        self.leave();
        Ok(())
    }
}

/// Seconds as a person reads them.
fn clock(secs: f64) -> String {
    let secs = secs.round() as u64;
    match secs {
        0..60 => format!("{secs} s"),
        60..3600 => format!("{} min {:02} s", secs / 60, secs % 60),
        _ => format!("{} h {:02} min", secs / 3600, secs % 3600 / 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_are_readable() {
        let read = [0.4, 59.4, 61.0, 3599.0, 7320.0].map(clock);
        assert_eq!(read, ["0 s", "59 s", "1 min 01 s", "59 min 59 s", "2 h 02 min"]);
    }

    #[test]
    fn the_estimate_counts_only_what_this_start_has_done() {
        let mut progress = Progress::new("test", 20, 10, 5);
        progress.running = 4;
        (0..40).for_each(|_| progress.stepped());
        assert_eq!(progress.line(Duration::from_secs(10)), "success 50 %, 4.0 steps/s, 4 running");
        progress.recorded(true, 10);
        progress.recorded(true, 10);
        // Two episodes had 10 steps each, so the eight that are left have 80; of these, 20 are done.
        assert_eq!(progress.line(Duration::from_secs(10)), "success 58 %, 4.0 steps/s, 15 s left");
    }
}
