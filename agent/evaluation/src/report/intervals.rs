//! Rows of values with their intervals on one axis: rates of several settings, or paired gains.

use std::fmt::Write;

use super::axis::Axis;
use super::escape;
use super::figure::{Drawing, Room};

/// One row.
pub struct IntervalRow {
    pub label: String,
    /// The strategy, so that the style sheet can give it its colour.
    pub strategy: String,
    /// Value and interval in percent or percentage points.
    pub value: f64,
    pub low: f64,
    pub high: f64,
    /// Value and interval in numbers, and how many episodes there are behind them.
    pub text: String,
    pub count: String,
}

/// What is beside the rows.
pub struct Frame<'a> {
    pub low: f64,
    pub high: f64,
    /// The axis's title, with its unit.
    pub title: &'a str,
    /// What the two sides of zero mean; none for rates.
    pub sides: Option<[&'a str; 2]>,
}

const WIDE: f64 = 860.0;
const NARROW: f64 = 350.0;
const LABELS: f64 = 290.0;
const VALUES: f64 = 250.0;
/// Room for the axis below the rows.
const BELOW: f64 = 44.0;

/// Draws the rows from the top.
pub fn draw(rows: &[IntervalRow], frame: &Frame<'_>, room: Room) -> Drawing {
    let (width, row_height, from, to) = match room {
        Room::Wide => (WIDE, 27.0, LABELS, WIDE - VALUES),
        Room::Narrow => (NARROW, 58.0, 16.0, NARROW - 16.0),
    };
    let top = if frame.sides.is_some() { 22.0 } else { 4.0 };
    let axis = Axis { low: frame.low, high: frame.high, from, to };
    let bottom = top + row_height * rows.len() as f64;
    let mut svg = String::new();
    grid(&mut svg, &axis, frame, (top, bottom), room);
    for (index, row) in rows.iter().enumerate() {
        let place = top + row_height * index as f64;
        let _ = write!(svg, "<g data-strategy=\"{}\">", escape::html(&row.strategy));
        let (label, text) = (escape::html(&row.label), escape::html(&row.text));
        let count = escape::html(&row.count);
        let middle = match room {
            Room::Wide => {
                let middle = place + row_height / 2.0;
                let _ = write!(
                    svg,
                    "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{label}</text>\
                     <text x=\"{:.1}\" y=\"{1:.1}\">{text} <tspan class=\"muted\">{count}</tspan></text>",
                    LABELS - 16.0,
                    middle + 4.5,
                    WIDE - VALUES + 16.0,
                );
                middle
            }
            Room::Narrow => {
                let _ = write!(
                    svg,
                    "<text x=\"2\" y=\"{:.1}\">{label}</text><text class=\"muted\" x=\"2\" y=\"{:.1}\">{text} {count}</text>",
                    place + 15.0,
                    place + 31.0,
                );
                place + 44.0
            }
        };
        mark(&mut svg, &axis, row, middle);
        svg.push_str("</g>");
    }
    Drawing { content: svg, width, height: bottom + BELOW }
}

/// The value as a dot on its interval, whose ends are marked.
fn mark(svg: &mut String, axis: &Axis, row: &IntervalRow, middle: f64) {
    let (low, high) = (axis.at(row.low), axis.at(row.high));
    let _ = write!(
        svg,
        "<path class=\"whisker\" d=\"M{low:.1} {middle:.1}H{high:.1}M{low:.1} {:.1}v8M{high:.1} {:.1}v8\"/>\
         <circle class=\"value\" cx=\"{:.1}\" cy=\"{middle:.1}\" r=\"5\"/>",
        middle - 4.0,
        middle - 4.0,
        axis.at(row.value),
    );
}

fn grid(svg: &mut String, axis: &Axis, frame: &Frame<'_>, (top, bottom): (f64, f64), room: Room) {
    let is_signed = frame.sides.is_some();
    for tick in axis.ticks(if room == Room::Wide { 6 } else { 4 }) {
        let place = axis.at(tick);
        let class = if is_signed && tick == 0.0 { "zero" } else { "grid" };
        let text = match (is_signed, tick == 0.0) {
            (true, false) => format!("{tick:+.0}").replace('-', "−"),
            _ => format!("{tick:.0}"),
        };
        let _ = write!(
            svg,
            "<line class=\"{class}\" x1=\"{place:.1}\" x2=\"{place:.1}\" y1=\"{top:.1}\" y2=\"{bottom:.1}\"/>\
             <text class=\"tick\" x=\"{place:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{text}</text>",
            bottom + 17.0,
        );
    }
    let _ = write!(
        svg,
        "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
        f64::midpoint(axis.from, axis.to),
        bottom + 36.0,
        escape::html(frame.title)
    );
    if let Some([left, right]) = frame.sides {
        let zero = axis.at(0.0);
        let _ = write!(
            svg,
            "<text class=\"tick\" x=\"{:.1}\" y=\"14\" text-anchor=\"end\">◂ {}</text>\
             <text class=\"tick\" x=\"{:.1}\" y=\"14\">{} ▸</text>",
            zero - 8.0,
            escape::html(left),
            zero + 8.0,
            escape::html(right)
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_has_its_label_its_value_and_its_interval_in_both_widths() {
        let row = IntervalRow {
            label: "a<b".into(),
            strategy: "verifier".into(),
            value: 50.0,
            low: 30.0,
            high: 70.0,
            text: "50.0 [30.0, 70.0]".into(),
            count: "24 episodes".into(),
        };
        let frame = Frame { low: 0.0, high: 100.0, title: "success (%)", sides: None };
        for room in [Room::Wide, Room::Narrow] {
            let svg = draw(std::slice::from_ref(&row), &frame, room).content;
            assert_eq!(svg.matches("<circle").count(), 1);
            assert_eq!(svg.matches("whisker").count(), 1);
            for text in ["a&lt;b", "50.0 [30.0, 70.0]", "24 episodes", "success (%)"] {
                assert!(svg.contains(text), "{text} in {svg}");
            }
        }
    }
}
