//! The sections of the page: the numbers of a run in tables and figures, with what to see in them.

use std::collections::BTreeSet;

use decision::{Strategy, TaskId};
use store::run::RunHeader;

use super::catalogue::task_words;
use super::curve::{Point, Series};
use super::escape::html;
use super::figure::{Figure, csv_line};
use super::forest::Comparison;
use super::glossary::{self, term, term_as};
use super::intervals::{Frame, IntervalRow};
use super::page::Page;
use super::scores::{Bin, Scored};
use super::{curve, forest, head, intervals, provenance, scores, tables};
use crate::calibration;
use crate::comparisons::{SettingGain, SettingHeadroom};
use crate::results::{Results, SettingResult};
use crate::statistics::auroc;

/// The whole page of a run.
pub fn page(
    header: &RunHeader,
    simulators: &BTreeSet<String>,
    results: &Results,
    scored: &[Scored],
) -> Page {
    let sections = [
        ("result", "Result", result(results)),
        ("gains", "Paired gains", gains(results)),
        ("candidates", "Success against the number of candidates", candidates(results)),
        ("tasks", "Success per task", tasks(results)),
        ("verifier", "What the verifier’s scores mean", verifier(scored)),
        ("run", "How this run was made", provenance::section(header, simulators)),
        ("terms", "Terms", glossary::list()),
    ];
    let build =
        header.starts.last().map_or_else(|| "rever".to_owned(), |start| start.build.to_string());
    let shown = || sections.iter().filter(|(_, _, body)| !body.is_empty());
    let links = shown().map(|(id, _, _)| format!("<a href=\"#{id}\">{id}</a>"));
    Page {
        title: format!("{} · rever", html(&header.run)),
        header: head::head(header, results),
        links: links.collect(),
        sections: shown()
            .map(|(id, title, body)| {
                format!("<section id=\"{id}\"><h2 tabindex=\"-1\">{title}</h2>{body}</section>\n")
            })
            .collect(),
        footer: format!("The episodes were run by {}.", html(&build)),
    }
}

fn result(results: &Results) -> String {
    format!(
        "<p class=\"note\">Percent of episodes, averaged over tasks, each of which counts the same. Below each rate is its \
         {}. {} is read at the last step.</p>{}<p class=\"note\">{} candidates are never executed. Without a well-formed \
         candidate the robot holds still. Episodes in which the policy never acted are in no rate. Repeats of an episode in \
         which nothing is drawn (T = 0) count once.</p>{}",
        term("95 % interval"),
        term_as("success", "Success"),
        tables::rates(&results.settings),
        term_as("malformed", "Malformed"),
        tables::counts(&results.settings),
    )
}

fn gains(results: &Results) -> String {
    let comparison = |gain: &SettingGain| Comparison {
        better: gain.better.to_string(),
        worse: gain.worse.to_string(),
        strategy: gain.better.strategy.to_string(),
        pairs: gain.gain.pairs as usize,
        gain: gain.gain.mean,
        low: gain.gain.interval.low,
        high: gain.gain.interval.high,
    };
    let comparisons: Vec<Comparison> = results.gains.iter().map(comparison).collect();
    let figure = forest::figure(&comparisons);
    if figure.is_empty() {
        return figure;
    }
    let headroom: Vec<String> = results.headroom.iter().map(headroom).collect();
    let headroom = match headroom.is_empty() {
        true => String::new(),
        false => format!(
            "<p class=\"note\">{} of the gap to the oracle: {}.</p>",
            term_as("headroom", "Headroom"),
            headroom.join(", ")
        ),
    };
    format!(
        "<p class=\"note\">The first setting minus the second, {} on the same {}s with the same random numbers and averaged \
         over tasks. The line is the {}. A line that crosses 0 leaves open which of the two is better.</p>{figure}{headroom}",
        term("paired"),
        term("initial layout"),
        term("95 % interval"),
    )
}

fn headroom(one: &SettingHeadroom) -> String {
    let headroom = &one.headroom;
    let interval = headroom.interval.map_or_else(
        || "no interval: the oracle may be no better than a single sample".to_owned(),
        |interval| format!("{:.0} to {:.0}", interval.low * 100.0, interval.high * 100.0),
    );
    format!(
        "{} {:.0} % ({interval}, {} episodes)",
        html(&one.setting.to_string()),
        headroom.fraction * 100.0,
        headroom.episodes
    )
}

fn candidates(results: &Results) -> String {
    let mut series: Vec<(Strategy, f32, Series)> = Vec::new();
    for result in results.settings.iter().filter(|result| result.setting.candidates > 1) {
        let (strategy, temperature) = (result.setting.strategy, result.setting.temperature);
        let known = series.iter().position(|(a, b, _)| (*a, *b) == (strategy, temperature));
        let place = known.unwrap_or_else(|| {
            // Choosing from one candidate is taking a single sample, so every line begins there.
            let is_start = |one: &&SettingResult| {
                one.setting.strategy == Strategy::Sample && one.setting.temperature == temperature
            };
            let start = results.settings.iter().find(is_start);
            let points = start.and_then(point).into_iter().collect();
            let label = format!("{strategy} T={temperature}");
            let name = strategy.to_string();
            series.push((strategy, temperature, Series { label, strategy: name, points }));
            series.len() - 1
        });
        series[place].2.points.extend(point(result));
    }
    // A line needs a second number of candidates beside the single sample that all share.
    series.retain(|(_, _, one)| one.points.iter().filter(|point| point.candidates > 1).count() > 1);
    let figure = curve::figure(&series.into_iter().map(|(_, _, one)| one).collect::<Vec<_>>());
    if figure.is_empty() {
        return figure;
    }
    format!(
        "<p class=\"note\">Success at the last step, averaged over tasks. Vertical lines are {}s; one candidate is a {}. \
         Lines are set apart sideways, so that none hides another.</p>{figure}",
        term("95 % interval"),
        term("single sample"),
    )
}

fn point(result: &SettingResult) -> Option<Point> {
    let interval = result.all.success.interval;
    Some(Point {
        candidates: result.setting.candidates as usize,
        rate: result.all.success.value?,
        low: interval.low,
        high: interval.high,
    })
}

fn verifier(scored: &[Scored]) -> String {
    // Where there was a choice the score decided it. Calibration is therefore computed from single samples.
    let mut single: Vec<Scored> = scored.iter().copied().filter(|one| !one.is_selected).collect();
    let mut kind = "single samples";
    if single.is_empty() {
        single = scored.to_vec();
        kind = "chosen among several, so that scores are high by selection";
    }
    let scored = &single[..];
    if scored.is_empty() {
        return String::new();
    }
    let successes = scored.iter().filter(|one| one.is_success).count();
    if successes == 0 || successes == scored.len() {
        return "<p class=\"note\">Scores are compared with outcomes when the run has successes and failures; so far it has \
                only one of the two.</p>"
            .to_owned();
    }
    let values: Vec<f32> = scored.iter().map(|one| one.score).collect();
    let labels: Vec<bool> = scored.iter().map(|one| one.is_success).collect();
    let bins = calibration::reliability(&values, &labels, calibration::BINS);
    let error = calibration::calibration_error(&bins);
    let bins: Vec<Bin> = bins
        .iter()
        .map(|bin| Bin {
            score_mean: bin.probability_mean,
            success_rate: bin.success_rate,
            count: bin.samples as usize,
        })
        .collect();
    let number = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
    format!(
        "<p class=\"note\">Scores of executed candidates that were {kind} ({} steps), against how \
         their episode ended. AUROC {}, expected calibration error {}. Both are over all tasks together, so that telling \
         easy tasks from hard ones is a part of them. The area of a dot is the number of its steps.</p>\
         <div class=\"halves\">{}{}</div>",
        scored.len(),
        number(auroc(&values, &labels)),
        number(error),
        panel("Reliability", &scores::reliability(&bins)),
        panel("Scores by outcome", &scores::by_outcome(scored))
    )
}

/// A titled figure beside others, or nothing.
fn panel(title: &str, figure: &str) -> String {
    if figure.is_empty() {
        return String::new();
    }
    format!("<div><h3>{title}</h3>{figure}</div>")
}

fn tasks(results: &Results) -> String {
    // One task alone is the table's first column.
    if results.tasks.len() < 2 {
        return String::new();
    }
    let figures: String = results
        .tasks
        .iter()
        .enumerate()
        .map(|(index, task)| {
            let rows: Vec<IntervalRow> =
                results.settings.iter().filter_map(|setting| rate_row(setting, index)).collect();
            panel(&html(&task_words(task)), &task_figure(task, &rows))
        })
        .collect();
    format!(
        "<p class=\"note\">Success at the last step with its {}.</p>{figures}",
        term("95 % interval")
    )
}

fn task_figure(task: &TaskId, rows: &[IntervalRow]) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let mut csv = csv_line(&["setting", "success", "low", "high", "episodes"].map(str::to_owned));
    for row in rows {
        let [value, low, high] = [row.value, row.low, row.high].map(|value| format!("{value:.3}"));
        let episodes = row.count.split(' ').next().unwrap_or_default().to_owned();
        csv.push_str(&csv_line(&[row.label.clone(), value, low, high, episodes]));
    }
    let described: Vec<String> =
        rows.iter().map(|row| format!("{}: {} %", row.label, row.text)).collect();
    let letters = |letter: char| if letter.is_ascii_alphanumeric() { letter } else { '-' };
    let name: String = task_words(task).chars().map(letters).collect();
    let figure = Figure {
        name: format!("success-{name}"),
        description: format!("Success on {}: {}", task_words(task), described.join("; ")),
        csv,
    };
    let frame = Frame { low: 0.0, high: 100.0, title: "success at the last step (%)", sides: None };
    figure.html(|room| intervals::draw(rows, &frame, room))
}

fn rate_row(result: &SettingResult, task: usize) -> Option<IntervalRow> {
    let rate = result.tasks.get(task)?.success;
    let interval = rate.interval;
    let [value, low, high] = [rate.value?, interval.low, interval.high].map(|value| 100.0 * value);
    Some(IntervalRow {
        label: result.setting.to_string(),
        strategy: result.setting.strategy.to_string(),
        value,
        low,
        high,
        text: format!("{value:.1} [{low:.1}, {high:.1}]"),
        count: format!("{} episodes", rate.episodes),
    })
}
