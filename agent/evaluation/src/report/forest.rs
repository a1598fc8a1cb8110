//! The forest plot: paired gains in percentage points with their intervals, one line per comparison.

use super::figure::{Figure, csv_line};
use super::intervals::{self, Frame, IntervalRow};

/// One comparison; gains are fractions of episodes, positive when the first setting is better.
pub struct Comparison {
    pub better: String,
    pub worse: String,
    /// Of the setting that is in question.
    pub strategy: String,
    pub pairs: usize,
    pub gain: f64,
    pub low: f64,
    pub high: f64,
}

/// Percentage points that the axis shows at least on either side of zero.
const SPAN_MIN: f64 = 5.0;

/// The figure, or nothing when there is nothing to compare.
pub fn figure(comparisons: &[Comparison]) -> String {
    if comparisons.is_empty() {
        return String::new();
    }
    let rows: Vec<IntervalRow> = comparisons.iter().map(row).collect();
    let low = rows.iter().map(|row| row.low).fold(-SPAN_MIN, f64::min);
    let high = rows.iter().map(|row| row.high).fold(SPAN_MIN, f64::max);
    let margin = ((high - low) * 0.05).max(1.0);
    let frame = Frame {
        low: low - margin,
        high: high + margin,
        title: "paired gain in success (percentage points)",
        sides: Some(["worse", "better"]),
    };
    let header = ["setting", "compared with", "gain", "low", "high", "pairs"].map(str::to_owned);
    let mut csv = csv_line(&header);
    for one in comparisons {
        let numbers = [one.gain, one.low, one.high].map(|value| format!("{:.3}", 100.0 * value));
        let [gain, low, high] = numbers;
        let cells = [one.better.clone(), one.worse.clone(), gain, low, high, one.pairs.to_string()];
        csv.push_str(&csv_line(&cells));
    }
    let described: Vec<String> =
        rows.iter().map(|row| format!("{}: {} {}", row.label, row.text, row.count)).collect();
    let figure = Figure {
        name: "paired-gains".to_owned(),
        description: format!(
            "Paired gains in percentage points with 95 % intervals. {}",
            described.join("; ")
        ),
        csv,
    };
    figure.html(|room| intervals::draw(&rows, &frame, room))
}

fn row(one: &Comparison) -> IntervalRow {
    let [value, low, high] = [one.gain, one.low, one.high].map(|value| 100.0 * value);
    IntervalRow {
        label: format!("{} − {}", one.better, one.worse),
        strategy: one.strategy.clone(),
        value,
        low,
        high,
        text: format!("{value:+.1} [{low:+.1}, {high:+.1}]").replace('-', "−"),
        count: format!("{} pairs", one.pairs),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_comparison_names_both_settings_and_which_side_is_better() {
        let one = Comparison {
            better: "verifier N=5 T=1".into(),
            worse: "a<b".into(),
            strategy: "verifier".into(),
            pairs: 40,
            gain: 0.119,
            low: -0.06,
            high: 0.18,
        };
        let text = figure(&[one]);
        assert!(text.contains("verifier N=5 T=1 − a&lt;b"), "{text}");
        assert!(text.contains("+11.9 [−6.0, +18.0]") && text.contains("40 pairs"), "{text}");
        assert!(text.contains("better ▸") && text.contains("◂ worse"), "{text}");
        assert!(text.contains("verifier N=5 T=1,a&lt;b,11.900,-6.000,18.000,40"), "{text}");
        assert_eq!(figure(&[]), "");
    }
}
