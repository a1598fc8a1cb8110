//! Live progress with the estimated time left: a bar in a terminal, plain lines elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use anyhow::Result;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use store::record::EpisodeIdentity;
use tokio::sync::watch;

use super::{Event, EventSink};

/// How often a plain line is printed where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);
/// Faults with the same reason within this time are reported together: a lost server breaks all of its episodes.
const SAME_FAULT: Duration = Duration::from_secs(2);
/// The rates of more strategies than this are shown as one.
const RATES_MAX: usize = 3;
/// Ticks of the bar. Progress is counted in control steps, whose final number is unknown.
const TICKS: u64 = 10_000;

/// Work done since the start of this process.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Control steps of all episodes.
    pub steps: u64,
    /// Recorded episodes.
    pub episodes: u64,
}

/// Progress of a run. Episodes recorded by an earlier process count as done, but not for the estimate.
pub struct Progress {
    bar: Option<ProgressBar>,
    is_silent: bool,
    /// Episodes recorded by an earlier process.
    before: u64,
    /// Episodes to record.
    waiting: u64,
    counts: watch::Sender<Counts>,
    /// Steps of the episodes recorded by this process.
    steps_recorded: u64,
    /// Steps per episode, used until one is recorded.
    steps_expected: f64,
    rates: Vec<StrategyRate>,
    faults: u64,
    last_fault: Option<LastFault>,
    started: Instant,
    printed: Instant,
}

/// Successes of one strategy.
struct StrategyRate {
    strategy: String,
    successes: u64,
    episodes: u64,
}

/// The last reported reason, and the number of further attempts that failed for it.
struct LastFault {
    reason: String,
    at: Instant,
    others: u64,
}

impl Progress {
    /// Of a run with `waiting` episodes to record, each of about `steps_expected` control steps.
    pub fn new(title: &str, waiting: u64, steps_expected: f64) -> Progress {
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("{prefix} {bar:20} {wide_msg}");
            let bar =
                ProgressBar::with_draw_target(Some(TICKS), ProgressDrawTarget::stderr_with_hz(4));
            bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
                .with_prefix(title.to_owned())
        });
        let now = Instant::now();
        Progress {
            bar,
            is_silent: false,
            before: 0,
            waiting,
            counts: watch::Sender::default(),
            steps_recorded: 0,
            steps_expected: steps_expected.max(1.0),
            rates: Vec::new(),
            faults: 0,
            last_fault: None,
            started: now,
            printed: now,
        }
    }

    /// Shows only faults and notices.
    pub fn silent(mut self) -> Progress {
        self.bar = None;
        self.is_silent = true;
        self
    }

    /// Counts an episode recorded by an earlier process.
    pub fn recorded_before(&mut self, identity: &EpisodeIdentity, is_success: bool) {
        self.before += 1;
        self.count(identity, is_success);
    }

    /// Counters for throughput measurement.
    pub fn counts(&self) -> watch::Receiver<Counts> {
        self.counts.subscribe()
    }

    fn count(&mut self, identity: &EpisodeIdentity, is_success: bool) {
        let strategy = &identity.strategy;
        let known = self.rates.iter().position(|rate| rate.strategy == *strategy);
        let index = known.unwrap_or(self.rates.len());
        if known.is_none() {
            self.rates.push(StrategyRate { strategy: strategy.clone(), successes: 0, episodes: 0 });
        }
        self.rates[index].episodes += 1;
        self.rates[index].successes += u64::from(is_success);
    }

    /// Counts one control step.
    fn stepped(&mut self) {
        self.counts.send_modify(|counts| counts.steps += 1);
        self.show();
    }

    /// Counts a recorded episode with its steps.
    fn recorded(&mut self, steps: usize) {
        self.counts.send_modify(|counts| counts.episodes += 1);
        self.steps_recorded += steps as u64;
        self.show();
    }

    /// Counts and reports a fault.
    fn faulted(&mut self, episode: &str, reason: &str) {
        self.faults += 1;
        if let Some(last) = &mut self.last_fault
            && last.reason == reason
            && last.at.elapsed() < SAME_FAULT
        {
            last.others += 1;
            return;
        }
        self.report_others();
        self.say(&format!("fault: {reason} ({episode})"));
        self.last_fault =
            Some(LastFault { reason: reason.to_owned(), at: Instant::now(), others: 0 });
    }

    /// Reports how many further attempts failed for the last reason.
    fn report_others(&mut self) {
        if let Some(LastFault { others: others @ 1.., .. }) = self.last_fault.take() {
            self.say(&format!("the same fault in {others} more attempts"));
        }
    }

    /// Prints a line without breaking the bar.
    fn say(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{line}")),
            None => eprintln!("{line}"),
        }
    }

    fn show(&mut self) {
        if self.last_fault.as_ref().is_some_and(|last| last.at.elapsed() >= SAME_FAULT) {
            self.report_others();
        }
        if self.is_silent {
            return;
        }
        let elapsed = self.started.elapsed();
        if let Some(bar) = &self.bar {
            bar.set_position((self.share() * TICKS as f64) as u64);
            bar.set_message(self.line(elapsed));
        } else if self.printed.elapsed() >= LINE_EVERY {
            self.printed = Instant::now();
            eprintln!("{}", self.line(elapsed));
        }
    }

    /// Steps per episode: measured once one is recorded.
    fn steps_each(&self) -> f64 {
        match self.counts.borrow().episodes {
            0 => self.steps_expected,
            episodes => self.steps_recorded as f64 / episodes as f64,
        }
    }

    /// Control steps left.
    fn steps_left(&self) -> f64 {
        let Counts { steps, episodes } = *self.counts.borrow();
        // Episodes that start together end together, so a rate of episodes comes in waves.
        let ahead = steps.saturating_sub(self.steps_recorded) as f64;
        (self.waiting.saturating_sub(episodes) as f64 * self.steps_each() - ahead).max(0.0)
    }

    /// The completed share of the run, 0 to 1.
    fn share(&self) -> f64 {
        let whole = (self.before + self.waiting) as f64 * self.steps_each();
        1.0 - self.steps_left() / whole.max(1.0)
    }

    fn line(&self, elapsed: Duration) -> String {
        let secs = elapsed.as_secs_f64().max(1e-3);
        let Counts { steps, episodes } = *self.counts.borrow();
        let (done, total) = (self.before + episodes, self.before + self.waiting);
        let mut parts = vec![format!("{done}/{total} episodes")];
        if episodes == self.waiting {
            parts.push(format!("in {}", clock(secs)));
        } else if steps > 0 {
            parts.push(format!("{} left", clock(self.steps_left() * secs / steps as f64)));
        }
        parts.push(format!("{:.1} steps/s", steps as f64 / secs));
        if self.rates.len() > RATES_MAX {
            let sum = |of: fn(&StrategyRate) -> u64| self.rates.iter().map(of).sum::<u64>();
            let (successes, episodes) = (sum(|one| one.successes), sum(|one| one.episodes));
            parts.push(format!("success {}", percent(successes, episodes)));
        } else {
            parts.extend(self.rates.iter().map(|rate| {
                format!("{} {}", rate.strategy, percent(rate.successes, rate.episodes))
            }));
        }
        if self.faults > 0 {
            parts.push(format!("{} faults", self.faults));
        }
        parts.join(", ")
    }
}

impl EventSink for Progress {
    fn on(&mut self, event: &Event) -> Result<()> {
        match event {
            Event::Started { .. } => {}
            Event::Stepped { .. } => self.stepped(),
            Event::Recorded(record) => {
                if record.has_outcome() {
                    self.count(&record.identity, record.statistics.is_success);
                }
                self.recorded(record.steps.len());
            }
            Event::Faulted(fault) => {
                let id = format!("{}, attempt {}", fault.identity.id(), fault.attempt);
                self.faulted(&id, &fault.reason);
            }
            Event::Notice(line) => self.say(line),
        }
        Ok(())
    }

    /// Leaves the last state on the screen.
    fn finish(&mut self) -> Result<()> {
        self.report_others();
        let line = self.line(self.started.elapsed());
        match &self.bar {
            Some(bar) => {
                bar.set_position((self.share() * TICKS as f64) as u64);
                bar.abandon_with_message(line);
            }
            None if !self.is_silent => eprintln!("{line}"),
            None => {}
        }
        Ok(())
    }
}

fn percent(successes: u64, episodes: u64) -> String {
    format!("{:.0} %", 100.0 * successes as f64 / episodes.max(1) as f64)
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

    fn identity(strategy: &str, episode: u32) -> EpisodeIdentity {
        EpisodeIdentity {
            run: "run".to_owned(),
            task: "stack".to_owned(),
            variant: "default".to_owned(),
            layout: None,
            seed: u64::from(episode),
            episode,
            strategy: strategy.to_owned(),
            candidates: 1,
            temperature: 1.0,
            sampling_seed: 0,
        }
    }

    #[test]
    fn durations_are_readable() {
        let read = [0.4, 59.4, 61.0, 3599.0, 7320.0].map(clock);
        assert_eq!(read, ["0 s", "59 s", "1 min 01 s", "59 min 59 s", "2 h 02 min"]);
    }

    #[test]
    fn the_estimate_is_there_from_the_first_step_and_counts_only_what_this_start_has_done() {
        let mut progress = Progress::new("test", 10, 20.0);
        (0..10).for_each(|episode| {
            progress.recorded_before(&identity("sample", episode), episode < 5)
        });
        (0..40).for_each(|_| progress.stepped());
        // Of ten episodes with about 20 steps each, 40 steps are done.
        let line = progress.line(Duration::from_secs(10));
        assert_eq!(line, "10/20 episodes, 40 s left, 4.0 steps/s, sample 50 %");
        assert!((progress.share() - 0.6).abs() < 1e-9, "{}", progress.share());
        for episode in 10..12 {
            progress.count(&identity("verifier", episode), true);
            progress.recorded(10);
        }
        // Two episodes had 10 steps each, so the eight that are left have 80; of these, 20 are done.
        let line = progress.line(Duration::from_secs(10));
        assert_eq!(line, "12/20 episodes, 15 s left, 4.0 steps/s, sample 50 %, verifier 100 %");
    }

    #[test]
    fn faults_with_one_reason_are_reported_together() {
        let mut progress = Progress::new("test", 10, 20.0);
        for episode in 0..8 {
            progress.faulted(&identity("sample", episode).id(), "server 27f5 is gone");
        }
        assert_eq!(progress.faults, 8);
        assert_eq!(progress.last_fault.as_ref().map(|last| last.others), Some(7));
        progress.faulted("another", "physics diverged");
        assert_eq!(progress.last_fault.as_ref().map(|last| last.others), Some(0));
    }
}
