//! How the verifier's scores relate to what happened: reliability and scores by outcome.

use std::fmt::Write;

use super::axis::Axis;

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

const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 320.0;
const HISTOGRAM_BINS: usize = 20;

/// Predicted score against the share of steps whose episode succeeded; the diagonal is perfect.
pub fn reliability(bins: &[Bin]) -> String {
    let most = bins.iter().map(|bin| bin.count).max().unwrap_or(0);
    if most == 0 {
        return String::new();
    }
    let across = Axis { low: 0.0, high: 1.0, from: 46.0, to: WIDTH - 14.0 };
    let up = Axis { low: 0.0, high: 1.0, from: HEIGHT - 44.0, to: 12.0 };
    let mut svg = open("verifier score against success rate");
    frame(&mut svg, &across, "mean score of the chosen candidate");
    for tick in up.ticks(5) {
        let place = up.at(tick);
        let _ = write!(
            svg,
            "<line class=\"grid\" x1=\"{:.1}\" x2=\"{:.1}\" y1=\"{place:.1}\" y2=\"{place:.1}\"/>\
             <text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{:.0} %</text>",
            across.from,
            across.to,
            across.from - 8.0,
            place + 4.0,
            tick * 100.0
        );
    }
    let _ = write!(
        svg,
        "<line class=\"zero dashed\" x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\"/>",
        across.from, up.from, across.to, up.to
    );
    let filled = || bins.iter().filter(|bin| bin.count > 0);
    let place =
        |bin: &Bin| format!("{:.1},{:.1}", across.at(bin.score_mean), up.at(bin.success_rate));
    let points: Vec<String> = filled().map(place).collect();
    let _ = write!(svg, "<g class=\"series series-0\"><polyline points=\"{}\"/>", points.join(" "));
    for bin in filled() {
        // The area of a dot is proportional to the number of steps behind it.
        let radius = 2.5 + 7.5 * (bin.count as f64 / most as f64).sqrt();
        let _ = write!(
            svg,
            "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"{radius:.1}\"><title>score {:.2}: {:.1} % success, \
             {} steps</title></circle>",
            across.at(bin.score_mean),
            up.at(bin.success_rate),
            bin.score_mean,
            bin.success_rate * 100.0,
            bin.count
        );
    }
    svg.push_str("</g></svg>");
    svg
}

/// Two histograms of scores, successes above the line and failures below, each as a share of its own.
pub fn by_outcome(scores: &[Scored]) -> String {
    let successes = shares(scores, true);
    let failures = shares(scores, false);
    let (Some(successes), Some(failures)) = (successes, failures) else {
        return String::new();
    };
    let top = successes.iter().chain(&failures).copied().fold(0.0, f64::max);
    let across = Axis { low: 0.0, high: 1.0, from: 46.0, to: WIDTH - 14.0 };
    let middle = (HEIGHT - 32.0) / 2.0;
    let reach = middle - 10.0;
    let mut svg = open("verifier scores of successes and failures");
    frame(&mut svg, &across, "score of the chosen candidate");
    let wide = (across.to - across.from) / HISTOGRAM_BINS as f64;
    for (name, values) in [("success", &successes), ("failure", &failures)] {
        for (index, value) in values.iter().enumerate() {
            let tall = value / top * reach;
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
         <text class=\"success\" x=\"{:.1}\" y=\"24\">success</text>\
         <text class=\"failure\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">failure</text></svg>",
        across.from,
        across.to,
        across.from + 4.0,
        across.to - 4.0,
        HEIGHT - 52.0
    );
    svg
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

fn open(label: &str) -> String {
    format!(
        "<svg class=\"figure scores\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" \
         aria-label=\"{label}\">"
    )
}

fn frame(svg: &mut String, across: &Axis, caption: &str) {
    for tick in across.ticks(5) {
        let _ = write!(
            svg,
            "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{tick:.1}</text>",
            across.at(tick),
            HEIGHT - 26.0
        );
    }
    let _ = write!(
        svg,
        "<text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{caption}</text>",
        across.to,
        HEIGHT - 8.0
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn empty_bins_are_left_out() {
        let bin = |count| Bin { score_mean: 0.25, success_rate: 0.5, count };
        assert_eq!(reliability(&[bin(3), bin(0)]).matches("<circle").count(), 1);
        assert_eq!(reliability(&[bin(0)]), "");
    }

    #[test]
    fn both_outcomes_are_needed_to_compare_them() {
        let success = Scored { score: 1.0, is_success: true, is_selected: false };
        let failure = Scored { score: 0.1, is_success: false, is_selected: false };
        assert_eq!(by_outcome(&[success, success]), "");
        let svg = by_outcome(&[success, failure]);
        assert_eq!(svg.matches("100.0 % of the steps of").count(), 2);
    }
}
