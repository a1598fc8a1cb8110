//! The sections of the page: what the numbers of a run look like in words, tables and figures.

use std::collections::BTreeSet;

use decision::{Strategy, TaskId};
use store::run::RunHeader;

use super::bars::Bar;
use super::catalogue::task_words;
use super::curve::{Point, Series};
use super::escape::html;
use super::forest::Comparison;
use super::page::Page;
use super::scores::{Bin, Scored};
use super::{bars, curve, forest, head, scores};
use crate::calibration;
use crate::comparisons::{SettingGain, SettingHeadroom};
use crate::estimate::Rate;
use crate::results::{Counts, Results, SettingResult};
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
        ("verifier", "What the verifier’s scores mean", verifier(scored)),
        ("tasks", "Success per task", tasks(results)),
    ];
    let build =
        header.starts.last().map_or_else(|| "rever".to_owned(), |start| start.build.to_string());
    let shown = || sections.iter().filter(|(_, _, body)| !body.is_empty());
    let links = shown().map(|(id, _, _)| format!("<a href=\"#{id}\">{id}</a>"));
    Page {
        title: format!("{} · rever", html(&header.run)),
        header: head::head(header, simulators, results),
        links: links.collect(),
        sections: shown()
            .map(|(id, title, body)| {
                format!("<section id=\"{id}\"><h2>{title}</h2>{body}</section>\n")
            })
            .collect(),
        footer: format!("The episodes were run by {}.", html(&build)),
    }
}

fn percent_with_interval(rate: Rate) -> String {
    let Some(value) = rate.value else { return "–".to_owned() };
    let interval = rate.interval;
    format!(
        "{:.1}<small>{:.1}–{:.1}</small>",
        value * 100.0,
        interval.low * 100.0,
        interval.high * 100.0
    )
}

fn result(results: &Results) -> String {
    let rates: String = results.settings.iter().map(rates).collect();
    let counts: String = results.settings.iter().map(counts).collect();
    format!(
        "<p class=\"note\">Percent of episodes with 95 % intervals, averaged over tasks, each of which counts the \
         same. Success is read at the last step; the columns beside it count success at any step, success with the \
         object released, and episodes in which the object was held at some step. Episodes that share an initial \
         layout are a cluster, which widens the interval.</p>{}\
         <p class=\"note\">Beside the rates: malformed candidates are never executed, and without a well-formed one \
         the robot holds still. Episodes in which the policy never acted and attempts that broke (faults) have no \
         outcome; repeats of an episode in which nothing is drawn count once.</p>{}",
        table(
            &["setting", "success", "at any step", "released", "ever grasped", "episodes"],
            &rates
        ),
        table(
            &["setting", "malformed candidates", "held steps", "never acted", "faults", "repeats"],
            &counts
        ),
    )
}

fn table(heads: &[&str], rows: &str) -> String {
    let heads: String = heads.iter().map(|head| format!("<th>{head}</th>")).collect();
    format!(
        "<div class=\"scroll\"><table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
    )
}

/// A row of a table over settings; cells are HTML already.
fn row(result: &SettingResult, cells: &[String]) -> String {
    let cells: String = cells.iter().map(|cell| format!("<td>{cell}</td>")).collect();
    let setting = result.setting;
    format!(
        "<tr data-strategy=\"{}\"><td>{}</td>{cells}</tr>",
        setting.strategy,
        html(&setting.to_string())
    )
}

fn rates(result: &SettingResult) -> String {
    let all = &result.all;
    let Rate { episodes, starts, .. } = all.success;
    let rates = [all.success, all.ever_success, all.released_success, all.grasped];
    let mut cells: Vec<String> = rates.into_iter().map(percent_with_interval).collect();
    cells[0] = format!("<b>{}</b>", cells[0]);
    cells.push(match episodes == starts {
        true => episodes.to_string(),
        false => format!("{episodes}<small>{starts} layouts</small>"),
    });
    row(result, &cells)
}

fn counts(result: &SettingResult) -> String {
    let Counts { faults, never_acted, repeats, proposed, malformed, decisions, held_steps } =
        result.all.counts;
    let share = |part: u64, whole: u64| format!("{part}<small>of {whole}</small>");
    let alarming = |count: u64| match count {
        0 => count.to_string(),
        count => format!("<span class=\"fault\">{count}</span>"),
    };
    let cells = [
        share(malformed, proposed),
        share(held_steps, decisions),
        alarming(never_acted),
        alarming(faults),
        repeats.to_string(),
    ];
    row(result, &cells)
}

fn gains(results: &Results) -> String {
    let comparison = |gain: &SettingGain| Comparison {
        label: format!("{} − {}", gain.better, gain.worse),
        episodes: gain.gain.pairs as usize,
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
            "<p class=\"note\">Headroom, the share of the gap between a single sample and the oracle that a setting \
             closes: {}.</p>",
            headroom.join(", ")
        ),
    };
    format!(
        "<p class=\"note\">Percentage points of success on the same initial layouts with the same random numbers, \
         averaged over tasks, with 95 % intervals. An interval that includes 0 leaves open which of the two is \
         better.</p>{figure}{headroom}"
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
            let label = format!("{strategy}, T={temperature}");
            series.push((strategy, temperature, Series { label, points }));
            series.len() - 1
        });
        series[place].2.points.extend(point(result));
    }
    // A line needs a second number of candidates beside the single sample that all share.
    series.retain(|(_, _, one)| one.points.iter().filter(|point| point.candidates > 1).count() > 1);
    let lines = series.len();
    let figure = curve::figure(&series.into_iter().map(|(_, _, one)| one).collect::<Vec<_>>());
    if figure.is_empty() {
        return figure;
    }
    let left_out = match lines.saturating_sub(curve::SERIES_MAX) {
        0 => String::new(),
        count => format!(" {count} more lines are left out here; the table of results has them."),
    };
    format!(
        "<p class=\"note\">Success at the last step, averaged over tasks, with 95 % intervals; one candidate is a \
         single sample.{left_out}</p>{figure}"
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
    // Where there was a choice the score decided it, so calibration is told from single samples.
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
         their episode ended: AUROC {}, expected calibration error {}, both over all tasks at once: \
         telling easy tasks from hard ones is part of it.</p>\
         <div class=\"pair\">{}{}</div>",
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
    let figure = |(index, task): (usize, &TaskId)| {
        let bars: Vec<Bar> = results
            .settings
            .iter()
            .filter_map(|setting| bar(setting, setting.tasks[index].success))
            .collect();
        format!("<div><h3>{}</h3>{}</div>", html(&task_words(task)), bars::figure(&bars))
    };
    let figures: String = results.tasks.iter().enumerate().map(figure).collect();
    format!("<div class=\"halves\">{figures}</div>")
}

fn bar(result: &SettingResult, rate: Rate) -> Option<Bar> {
    let interval = rate.interval;
    Some(Bar {
        label: result.setting.to_string(),
        strategy: result.setting.strategy.to_string(),
        rate: rate.value?,
        low: interval.low,
        high: interval.high,
        episodes: rate.episodes as usize,
    })
}
