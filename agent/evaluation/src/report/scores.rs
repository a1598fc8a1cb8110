//! How the verifier's scores relate to what happened: reliability and scores by outcome.

use std::fmt::Write;

use super::axis::Axis;
use super::figure::{Drawing, Figure, Room, csv_line};

/// Scores that fell into one interval; both values are fractions.
pub struct Bin {
    pub score_mean: f64,
    pub success_rate: f64,
    pub count: usize,
}

/// A chosen candidate's score and whether its episode succeeded.
#[derive(Clone, Copy)]
pub struct Scored {
    pub score: f32,
    pub is_success: bool,
    /// Whether it was chosen among several: such scores run high or low by selection.
    pub is_selected: bool,
}

const HEIGHT: f64 = 330.0;
const LEFT: f64 = 52.0;
const HISTOGRAM_BINS: usize = 20;

fn width(room: Room) -> f64 {
    if room == Room::Wide { 460.0 } else { 350.0 }
}

fn axes(room: Room) -> (Axis, Axis) {
    let across = Axis { low: 0.0, high: 1.0, from: LEFT, to: width(room) - 14.0 };
    (across, Axis { low: 0.0, high: 1.0, from: HEIGHT - 48.0, to: 30.0 })
}

/// Predicted score against the share of steps whose episode succeeded; the diagonal is perfect.
pub fn reliability(bins: &[Bin]) -> String {
    let filled: Vec<&Bin> = bins.iter().filter(|bin| bin.count > 0).collect();
    let Some(most) = filled.iter().map(|bin| bin.count).max() else { return String::new() };
    let mut csv = csv_line(&["score_mean", "success_rate", "steps"].map(str::to_owned));
    for bin in &filled {
        let rates = [bin.score_mean, bin.success_rate].map(|value| format!("{value:.4}"));
        let [score, success] = rates;
        csv.push_str(&csv_line(&[score, success, bin.count.to_string()]));
    }
    let figure = Figure {
        name: "reliability".to_owned(),
        description: "Share of steps whose episode succeeded, against the mean score of the executed candidates; \
                      on the diagonal scores are calibrated"
            .to_owned(),
        csv,
    };
    figure.html(|room| draw_reliability(&filled, most, room))
}

fn draw_reliability(bins: &[&Bin], most: usize, room: Room) -> Drawing {
    let (across, up) = axes(room);
    let mut svg = String::new();
    frame(
        &mut svg,
        &across,
        "mean score of the executed candidates",
        "steps of successful episodes (%)",
    );
    for tick in up.ticks(5) {
        let place = up.at(tick);
        let _ = write!(
            svg,
            "<line class=\"grid\" x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{place:.1}\" y2=\"{place:.1}\"/>\
             <text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{:.0}</text>",
            across.from,
            across.to,
            across.from - 8.0,
            place + 4.0,
            tick * 100.0
        );
    }
    let _ = write!(
        svg,
        "<line class=\"zero dashed\" x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\"/>\
         <text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">calibrated</text>",
        across.from,
        up.from,
        across.to,
        up.to,
        across.at(0.78),
        up.at(0.86)
    );
    let place =
        |bin: &&Bin| format!("{:.1},{:.1}", across.at(bin.score_mean), up.at(bin.success_rate));
    let points: Vec<String> = bins.iter().map(place).collect();
    let _ = write!(
        svg,
        "<g class=\"series\" data-strategy=\"verifier\"><polyline points=\"{}\"/>",
        points.join(" ")
    );
    for bin in bins {
        // The area of a dot is proportional to the number of steps behind it.
        let radius = 2.5 + 7.5 * (bin.count as f64 / most as f64).sqrt();
        let _ = write!(
            svg,
            "<circle class=\"value\" cx=\"{:.1}\" cy=\"{:.1}\" r=\"{radius:.1}\"><title>score {:.2}: {:.1} % success, \
             {} steps</title></circle>",
            across.at(bin.score_mean),
            up.at(bin.success_rate),
            bin.score_mean,
            bin.success_rate * 100.0,
            bin.count
        );
    }
    svg.push_str("</g>");
    Drawing { content: svg, width: width(room), height: HEIGHT }
}

/// Two histograms of scores, successes above the line and failures below, each as a share of its own.
pub fn by_outcome(scores: &[Scored]) -> String {
    let successes = shares(scores, true);
    let failures = shares(scores, false);
    let (Some(successes), Some(failures)) = (successes, failures) else {
        return String::new();
    };
    let header = ["score_from", "score_to", "share_of_success_steps", "share_of_failure_steps"];
    let mut csv = csv_line(&header.map(str::to_owned));
    for (index, (success, failure)) in successes.iter().zip(&failures).enumerate() {
        let edge = |index: usize| index as f64 / HISTOGRAM_BINS as f64;
        let cells = [edge(index), edge(index + 1), *success, *failure];
        csv.push_str(&csv_line(&cells.map(|value| format!("{value:.4}"))));
    }
    let figure = Figure {
        name: "scores-by-outcome".to_owned(),
        description: "Histograms of the scores of executed candidates: in successful episodes above the line, in \
                      failed ones below it"
            .to_owned(),
        csv,
    };
    figure.html(|room| draw_by_outcome([&successes, &failures], room))
}

fn draw_by_outcome([successes, failures]: [&[f64]; 2], room: Room) -> Drawing {
    let top = successes.iter().chain(failures).copied().fold(0.0, f64::max);
    let (across, up) = axes(room);
    let middle = f64::midpoint(up.from, up.to);
    let half = (up.from - up.to) / 2.0 - 4.0;
    let wide = (across.to - across.from) / HISTOGRAM_BINS as f64;
    let mut svg = String::new();
    frame(&mut svg, &across, "score of the executed candidate", "share of steps (%)");
    for share in [-top, 0.0, top] {
        let _ = write!(
            svg,
            "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{:.0}</text>",
            across.from - 8.0,
            middle - share / top * half + 4.0,
            share.abs() * 100.0
        );
    }
    for (name, values) in [("success", successes), ("failure", failures)] {
        for (index, value) in values.iter().enumerate().filter(|(_, value)| **value > 0.0) {
            let tall = value / top * half;
            let y = if name == "success" { middle - tall } else { middle };
            let _ = write!(
                svg,
                "<rect class=\"{name}\" x=\"{:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"{tall:.1}\">\
                 <title>{:.1} % of the steps of {name} episodes</title></rect>",
                across.from + wide * index as f64 + 0.5,
                wide - 1.0,
                value * 100.0
            );
        }
    }
    let _ = write!(
        svg,
        "<line class=\"zero\" x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{middle:.1}\" y2=\"{middle:.1}\"/>\
         <text class=\"success\" x=\"{:.1}\" y=\"{:.1}\">successful episodes</text>\
         <text class=\"failure\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">failed episodes</text>",
        across.from,
        across.to,
        across.from + 4.0,
        up.to + 12.0,
        across.to - 4.0,
        up.from - 6.0
    );
    Drawing { content: svg, width: width(room), height: HEIGHT }
}

fn shares(scores: &[Scored], is_success: bool) -> Option<Vec<f64>> {
    let mut counts = vec![0usize; HISTOGRAM_BINS];
    for one in scores.iter().filter(|one| one.is_success == is_success) {
        let bin = (f64::from(one.score).clamp(0.0, 1.0) * HISTOGRAM_BINS as f64) as usize;
        counts[bin.min(HISTOGRAM_BINS - 1)] += 1;
    }
    let total: usize = counts.iter().sum();
    (total > 0).then(|| counts.into_iter().map(|count| count as f64 / total as f64).collect())
}

/// The axis below with its title, and the title of the one on the left.
fn frame(svg: &mut String, across: &Axis, below: &str, left: &str) {
    for tick in across.ticks(5) {
        let _ = write!(
            svg,
            "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{tick:.1}</text>",
            across.at(tick),
            HEIGHT - 28.0
        );
    }
    let _ = write!(
        svg,
        "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{below}</text>\
         <text class=\"tick\" x=\"2\" y=\"14\">{left}</text>",
        f64::midpoint(across.from, across.to),
        HEIGHT - 8.0
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn empty_bins_are_left_out() {
        let bin = |count| Bin { score_mean: 0.25, success_rate: 0.5, count };
        assert_eq!(reliability(&[bin(3), bin(0)]).matches("<circle").count(), 2, "in two widths");
        assert_eq!(reliability(&[bin(0)]), "");
    }

    #[test]
    fn both_outcomes_are_needed_to_compare_them() {
        let success = Scored { score: 1.0, is_success: true, is_selected: false };
        let failure = Scored { score: 0.1, is_success: false, is_selected: false };
        assert_eq!(by_outcome(&[success, success]), "");
        let text = by_outcome(&[success, failure]);
        assert_eq!(text.matches("100.0 % of the steps of").count(), 2 * 2, "in two widths");
    }
}
