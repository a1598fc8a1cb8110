//! The headline of tables and page: the main result of a run, with its interval and its number of episodes.

use decision::{Setting, Strategy};

use crate::comparisons::SettingGain;
use crate::estimate::Rate;
use crate::results::{Results, SettingResult};
use crate::statistics::Interval;

/// A statement, the gain and a verdict on it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Headline {
    /// Before the figure.
    pub statement: String,
    /// The gain with its sign, if two settings are compared.
    pub gain: Option<String>,
    /// After the figure.
    pub remark: String,
}

impl Headline {
    /// The verifier compared with a single sample. If either is missing, the first setting alone; without any, `None`.
    pub fn new(results: &Results) -> Option<Headline> {
        match results.main_gain() {
            Some(main) => Some(compared(main)),
            None => results.settings.first().map(alone),
        }
    }

    /// The whole headline as one text.
    pub fn text(&self) -> String {
        let parts = [Some(self.statement.as_str()), self.gain.as_deref(), Some(&self.remark)];
        parts.into_iter().flatten().collect::<Vec<_>>().join(" ")
    }
}

fn compared(main: &SettingGain) -> Headline {
    let gain = &main.gain;
    let verdict = match (gain.interval.low > 0.0, gain.interval.high < 0.0, gain.pairs_to_tell()) {
        (true, _, _) => "The verifier is better.".to_owned(),
        (_, true, _) => "The verifier is worse.".to_owned(),
        (_, _, Some(pairs)) => format!(
            "Not clear yet: the interval includes 0. About {pairs} pairs would show a gain of this size (80 % power)."
        ),
        (_, _, None) => "Not clear yet: the interval includes 0.".to_owned(),
    };
    let Setting { candidates, temperature, .. } = main.better;
    Headline {
        statement: format!(
            "The verifier's choice among {candidates} candidates (T={temperature}) succeeds in {:.1} % of episodes, a \
             single sample in {:.1} %:",
            100.0 * gain.better_rate,
            100.0 * gain.worse_rate,
        ),
        gain: Some(format!("{:+.1} percentage points", 100.0 * gain.mean)),
        remark: format!(
            "(95 % interval {}, {} pairs). {verdict}",
            signed(gain.interval),
            gain.pairs
        ),
    }
}

fn alone(first: &SettingResult) -> Headline {
    let Rate { value, interval, episodes, .. } = first.all.success;
    let name = match first.setting.strategy {
        Strategy::Sample => format!("A single sample ({})", first.setting),
        _ => format!("{}", first.setting),
    };
    let statement = match value {
        Some(value) => format!(
            "{name} succeeds in {:.1} % of episodes (95 % interval {:.1} to {:.1}, {episodes} episodes).",
            100.0 * value,
            100.0 * interval.low,
            100.0 * interval.high,
        ),
        None => format!("{name} has no episode with an outcome on at least one task yet."),
    };
    Headline { statement, gain: None, remark: String::new() }
}

/// The ends of an interval of differences, with their signs.
fn signed(interval: Interval) -> String {
    format!("{:+.1} to {:+.1}", 100.0 * interval.low, 100.0 * interval.high)
}
