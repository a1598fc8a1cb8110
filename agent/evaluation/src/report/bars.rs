//! Success on one task: one bar per setting, with its interval.

use std::fmt::Write;

use super::axis::Axis;
use super::escape;

/// One strategy's success on one task.
pub struct Bar {
    pub label: String,
    /// The strategy's name, so that the style sheet can give it its colour.
    pub strategy: String,
    pub rate: f64,
    pub low: f64,
    pub high: f64,
    pub episodes: usize,
}

const ROW: f64 = 18.0;
const WIDTH: f64 = 640.0;
const LABELS: f64 = 180.0;
const VALUES: f64 = 110.0;

/// The figure, or nothing without bars.
pub fn figure(bars: &[Bar]) -> String {
    if bars.is_empty() {
        return String::new();
    }
    let height = bars.len() as f64 * ROW + 28.0;
    let axis = Axis { low: 0.0, high: 100.0, from: LABELS, to: WIDTH - VALUES };
    let mut svg = format!(
        "<svg class=\"figure bars\" viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" \
         aria-label=\"success per strategy\">"
    );
    for tick in axis.ticks(5) {
        let place = axis.at(tick);
        let _ = write!(
            svg,
            "<line class=\"grid\" x1=\"{place:.1}\" x2=\"{place:.1}\" y1=\"4\" y2=\"{:.1}\"/>\
             <text class=\"tick\" x=\"{place:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{tick:.0} %</text>",
            height - 22.0,
            height - 6.0
        );
    }
    for (index, bar) in bars.iter().enumerate() {
        draw(&mut svg, bar, &axis, index as f64 * ROW + 4.0);
    }
    svg.push_str("</svg>");
    svg
}

fn draw(svg: &mut String, bar: &Bar, axis: &Axis, top: f64) {
    let middle = top + ROW / 2.0;
    let _ = write!(
        svg,
        "<g data-strategy=\"{}\"><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>\
         <rect x=\"{LABELS}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" rx=\"2\"/>\
         <line class=\"whisker\" x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{middle:.1}\" y2=\"{middle:.1}\"/>\
         <text class=\"value\" x=\"{:.1}\" y=\"{:.1}\">{:.1} % <tspan class=\"muted\">n {}</tspan></text></g>",
        escape::html(&bar.strategy),
        LABELS - 10.0,
        middle + 4.0,
        escape::html(&bar.label),
        top + 2.0,
        (axis.at(bar.rate * 100.0) - LABELS).max(1.0),
        ROW - 4.0,
        axis.at(bar.low * 100.0),
        axis.at(bar.high * 100.0),
        WIDTH - VALUES + 14.0,
        middle + 4.0,
        bar.rate * 100.0,
        bar.episodes
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bar_has_its_value_and_its_interval() {
        let bar = Bar {
            label: "greedy".into(),
            strategy: "greedy".into(),
            rate: 0.5,
            low: 0.3,
            high: 0.7,
            episodes: 24,
        };
        let svg = figure(&[bar]);
        assert_eq!(svg.matches("<rect").count(), 1);
        assert_eq!(svg.matches("whisker").count(), 1);
        assert!(svg.contains("50.0 %"), "{svg}");
        assert_eq!(figure(&[]), "");
    }
}
