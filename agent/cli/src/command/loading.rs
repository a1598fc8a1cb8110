//! The progress of loading a checkpoint: a bar in a terminal, plain lines elsewhere, nothing with -q.

use std::cell::RefCell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use tracing::Level;
use vla::Loaded;

/// A load that is done sooner shows nothing.
const SILENT: Duration = Duration::from_secs(1);
/// How often a plain line is printed where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// The progress of one load.
pub struct LoadingProgress {
    name: String,
    is_shown: bool,
    is_terminal: bool,
    started: Instant,
    state: RefCell<State>,
}

#[derive(Default)]
struct State {
    bar: Option<ProgressBar>,
    printed: Option<Instant>,
}

impl LoadingProgress {
    /// For the checkpoint called `name`. With -q nothing is shown.
    pub fn new(name: String) -> LoadingProgress {
        LoadingProgress {
            name,
            is_shown: tracing::enabled!(Level::WARN),
            is_terminal: std::io::stderr().is_terminal(),
            started: Instant::now(),
            state: RefCell::default(),
        }
    }

    /// Shows how far the load is.
    pub fn report(&self, loaded: Loaded) {
        let elapsed = self.started.elapsed();
        if !self.is_shown || elapsed < SILENT {
            return;
        }
        let mut state = self.state.borrow_mut();
        if self.is_terminal {
            let bar = state.bar.get_or_insert_with(|| self.bar(loaded.bytes_total));
            bar.set_position(loaded.bytes);
            bar.set_message(line(loaded, elapsed));
            if loaded.bytes == loaded.bytes_total {
                bar.finish_and_clear();
            }
        } else if state.printed.is_none_or(|printed| printed.elapsed() >= LINE_EVERY) {
            state.printed = Some(Instant::now());
            eprintln!("loading {}: {}", self.name, line(loaded, elapsed));
        }
    }

    /// Says how long it took, if progress was shown.
    pub fn finish(&self) {
        let state = self.state.borrow();
        if state.bar.is_some() || state.printed.is_some() {
            eprintln!("loaded {} in {:.0} s", self.name, self.started.elapsed().as_secs_f64());
        }
    }

    fn bar(&self, bytes: u64) -> ProgressBar {
        let style = ProgressStyle::with_template("loading {prefix} {bar:20} {wide_msg}");
        let target = ProgressDrawTarget::stderr_with_hz(4);
        ProgressBar::with_draw_target(Some(bytes), target)
            .with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
            .with_prefix(self.name.clone())
    }
}

/// Bytes done and seconds left.
fn line(Loaded { bytes, bytes_total }: Loaded, elapsed: Duration) -> String {
    let (done, total) = (bytes as f64 / 1e9, bytes_total as f64 / 1e9);
    let left = elapsed.as_secs_f64() * (total - done) / done.max(1e-9);
    format!("{done:.1} of {total:.1} GB, {left:.0} s left")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_has_bytes_and_the_time_left() {
        let loaded = Loaded { bytes: 5_000_000_000, bytes_total: 15_000_000_000 };
        assert_eq!(line(loaded, Duration::from_secs(40)), "5.0 of 15.0 GB, 80 s left");
    }
}
