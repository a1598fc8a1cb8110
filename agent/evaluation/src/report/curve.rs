//! Success against the number of candidates: one line per strategy and temperature, with a band.

use std::fmt::Write;

use super::axis::Axis;
use super::escape;

/// One line of the figure; rates are fractions.
pub struct Series {
    pub label: String,
    pub points: Vec<Point>,
}

/// Success with its 95 % interval at one number of candidates.
pub struct Point {
    pub candidates: usize,
    pub rate: f64,
    pub low: f64,
    pub high: f64,
}

const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 320.0;
/// Lines of one figure; more cannot be told apart.
pub const SERIES_MAX: usize = 6;

/// The figure, or nothing when no strategy ran with at least two numbers of candidates.
pub fn figure(series: &[Series]) -> String {
    let series: Vec<&Series> =
        series.iter().filter(|one| one.points.len() > 1).take(SERIES_MAX).collect();
    let points = || series.iter().flat_map(|one| &one.points);
    let Some(most) = points().map(|point| point.candidates).max() else {
        return String::new();
    };
    let top = points().map(|point| point.high).fold(0.0, f64::max);
    let bottom = points().map(|point| point.low).fold(1.0, f64::min);
    let across = Axis { low: 1.0, high: most as f64, from: 46.0, to: WIDTH - 16.0 };
    let up = Axis {
        low: (bottom * 10.0).floor() * 10.0,
        high: (top * 10.0).ceil() * 10.0,
        from: HEIGHT - 44.0,
        to: 12.0,
    };
    let mut svg = format!(
        "<svg class=\"figure curve\" viewBox=\"0 0 {WIDTH} {}\" role=\"img\" \
         aria-label=\"success against the number of candidates\">",
        HEIGHT + 20.0 * series.len() as f64
    );
    frame(&mut svg, &up, &across, points().map(|point| point.candidates));
    for (index, one) in series.iter().enumerate() {
        line(&mut svg, index, one, &across, &up);
    }
    svg.push_str("</svg>");
    svg
}

fn frame(svg: &mut String, up: &Axis, across: &Axis, candidates: impl Iterator<Item = usize>) {
    for tick in up.ticks(5) {
        let place = up.at(tick);
        let _ = write!(
            svg,
            "<line class=\"grid\" x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{place:.1}\" y2=\"{place:.1}\"/>\
             <text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{tick:.0} %</text>",
            across.from,
            across.to,
            across.from - 8.0,
            place + 4.0
        );
    }
    let places: std::collections::BTreeSet<usize> = candidates.collect();
    for count in places {
        let _ = write!(
            svg,
            "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{count}</text>",
            across.at(count as f64),
            HEIGHT - 26.0
        );
    }
    let _ = write!(
        svg,
        "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">candidates per step</text>",
        across.to,
        HEIGHT - 8.0
    );
}

fn line(svg: &mut String, index: usize, one: &Series, across: &Axis, up: &Axis) {
    let place = |point: &Point, rate: f64| {
        format!("{:.1},{:.1}", across.at(point.candidates as f64), up.at(rate * 100.0))
    };
    let upper = one.points.iter().map(|point| place(point, point.high));
    let lower = one.points.iter().rev().map(|point| place(point, point.low));
    let band: Vec<String> = upper.chain(lower).collect();
    let middle: Vec<String> = one.points.iter().map(|point| place(point, point.rate)).collect();
    let _ = write!(
        svg,
        "<g class=\"series series-{index}\"><polygon points=\"{}\"/><polyline points=\"{}\"/>",
        band.join(" "),
        middle.join(" ")
    );
    for point in &one.points {
        let _ = write!(
            svg,
            "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"4\"><title>{} candidates: {:.1} % \
             [{:.1}, {:.1}]</title></circle>",
            across.at(point.candidates as f64),
            up.at(point.rate * 100.0),
            point.candidates,
            point.rate * 100.0,
            point.low * 100.0,
            point.high * 100.0
        );
    }
    let below = HEIGHT + 20.0 * index as f64 + 6.0;
    let _ = write!(
        svg,
        "<line class=\"key\" x1=\"46\" x2=\"68\" y1=\"{:.1}\" y2=\"{:.1}\"/>\
         <text x=\"76\" y=\"{below:.1}\">{}</text></g>",
        below - 4.0,
        below - 4.0,
        escape::html(&one.label)
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_needs_two_numbers_of_candidates() {
        let point =
            |candidates, rate| Point { candidates, rate, low: rate - 0.1, high: rate + 0.1 };
        let mut series = vec![Series { label: "verifier".into(), points: vec![point(1, 0.3)] }];
        assert_eq!(figure(&series), "");
        series[0].points.push(point(5, 0.42));
        let svg = figure(&series);
        assert_eq!(svg.matches("<circle").count(), 2);
        assert!(svg.contains("5 candidates: 42.0 % [32.0, 52.0]"), "{svg}");
    }
}
