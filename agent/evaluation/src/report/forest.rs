//! The forest plot: paired gains in percentage points with their intervals, one line per comparison.

use std::fmt::Write;

use super::axis::Axis;
use super::escape;

/// One comparison; gains are fractions of episodes, positive when the first strategy is better.
pub struct Comparison {
    pub label: String,
    pub episodes: usize,
    pub gain: f64,
    pub low: f64,
    pub high: f64,
}

const WIDTH: f64 = 860.0;
const LABELS: f64 = 300.0;
const VALUES: f64 = 215.0;
const ROW: f64 = 26.0;
/// Percentage points that the axis shows at least on either side of zero.
const SPAN_MIN: f64 = 5.0;

/// The figure, or nothing when there is nothing to compare.
pub fn figure(comparisons: &[Comparison]) -> String {
    if comparisons.is_empty() {
        return String::new();
    }
    let points: Vec<(f64, f64, f64)> = comparisons
        .iter()
        .map(|one| (one.gain * 100.0, one.low * 100.0, one.high * 100.0))
        .collect();
    let low = points.iter().map(|point| point.1).fold(-SPAN_MIN, f64::min);
    let high = points.iter().map(|point| point.2).fold(SPAN_MIN, f64::max);
    let margin = ((high - low) * 0.05).max(1.0);
    let axis = Axis { low: low - margin, high: high + margin, from: LABELS, to: WIDTH - VALUES };
    let height = ROW * comparisons.len() as f64 + 34.0;
    let mut svg = format!(
        "<svg class=\"figure forest\" viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" \
         aria-label=\"paired gains with 95 % intervals\">"
    );
    let bottom = height - 24.0;
    for tick in axis.ticks(6) {
        let place = axis.at(tick);
        let class = if tick == 0.0 { "zero" } else { "grid" };
        let _ = write!(
            svg,
            "<line class=\"{class}\" x1=\"{place:.1}\" x2=\"{place:.1}\" y1=\"2\" y2=\"{bottom:.1}\"/>\
             <text class=\"tick\" x=\"{place:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
            bottom + 16.0,
            if tick == 0.0 { "0".to_owned() } else { format!("{tick:+.0}") }
        );
    }
    for (index, (one, (gain, low, high))) in comparisons.iter().zip(points).enumerate() {
        let middle = ROW * (index as f64 + 0.5) + 4.0;
        let class = match (low > 0.0, high < 0.0) {
            (true, _) => "better",
            (_, true) => "worse",
            _ => "open",
        };
        let _ = write!(
            svg,
            "<g class=\"{class}\"><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>\
             <line class=\"whisker\" x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{middle:.1}\" y2=\"{middle:.1}\"/>\
             <circle cx=\"{:.1}\" cy=\"{middle:.1}\" r=\"5\"/>\
             <text class=\"value\" x=\"{:.1}\" y=\"{:.1}\">{gain:+.1} [{low:+.1}, {high:+.1}] \
             <tspan class=\"muted\">{} pairs</tspan></text></g>",
            LABELS - 14.0,
            middle + 4.0,
            escape::html(&one.label),
            axis.at(low),
            axis.at(high),
            axis.at(gain),
            WIDTH - VALUES + 12.0,
            middle + 4.0,
            one.episodes,
        );
    }
    svg.push_str("</svg>");
    svg
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(label: &str, gain: f64, low: f64, high: f64) -> Comparison {
        Comparison { label: label.to_owned(), episodes: 40, gain, low, high }
    }

    #[test]
    fn an_interval_above_zero_is_marked_better_and_labels_are_escaped() {
        let svg = figure(&[one("a<b", 0.119, 0.06, 0.18), one("even", 0.0, -0.1, 0.1)]);
        assert!(svg.contains("class=\"better\"") && svg.contains("class=\"open\""), "{svg}");
        assert!(svg.contains("a&lt;b") && svg.contains("+11.9 [+6.0, +18.0]"), "{svg}");
        assert_eq!(figure(&[]), "");
    }
}
