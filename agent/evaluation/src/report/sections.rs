//! The sections of the page: what the numbers of a run look like in words, tables and figures.
use std::collections::BTreeSet;

use serde_json::Value;

use super::bars::Bar;
use super::catalogue::task_words;
use super::curve::{Point, Series};
use super::escape::html;
use super::forest::Comparison;
use super::page::Page;
use super::scores::{Bin, Scored};
use super::{bars, curve, forest, scores};
use crate::calibration;
use crate::results::{Rates, Results, SettingGain, SettingResult, StepTime};
use crate::statistics::{Rate, auroc};
use decision::{Strategy, TaskId};
use store::run::RunHeader;

/// A digest is known by its beginning.
const VERSION_LETTERS: usize = 16;

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
    let rever = header.versions.get("rever").and_then(Value::as_str).unwrap_or("unknown");
    let shown = || sections.iter().filter(|(_, _, body)| !body.is_empty());
    let links = shown().map(|(id, _, _)| format!("<a href=\"#{id}\">{id}</a>"));
    Page {
        title: format!("{} · rever", html(&header.run)),
        header: head(header, simulators, results),
        links: links.collect(),
        sections: shown()
            .map(|(id, title, body)| {
                format!("<section id=\"{id}\"><h2>{title}</h2>{body}</section>\n")
            })
            .collect(),
        footer: format!("Made by rever {} from the records of the run.", html(rever)),
    }
}

fn head(header: &RunHeader, simulators: &BTreeSet<String>, results: &Results) -> String {
    let episodes: u64 = results.settings.iter().map(|setting| setting.all.success.trials).sum();
    let faults: u64 = results.settings.iter().map(|setting| setting.all.faults).sum();
    let mut facts = vec![("episodes", episodes.to_string()), ("faults", faults.to_string())];
    let times = [
        ("a decision takes", results.decision_ms),
        ("a step takes", results.step_ms),
        ("its simulator takes", results.simulator_ms),
    ];
    for (what, StepTime { p50, p95 }) in
        times.into_iter().filter_map(|(what, time)| Some((what, time?)))
    {
        facts.push((what, format!("{p50:.1} ms (p95 {p95:.1} ms)")));
    }
    let simulators: Vec<&str> = simulators.iter().map(String::as_str).collect();
    facts.push(("simulator", simulators.join(", ")));
    for name in ["policy", "verifier"] {
        if let Some(version) = header.versions.get(name).and_then(Value::as_str) {
            facts.push((name, version.chars().take(VERSION_LETTERS).collect()));
        }
    }
    let facts: String = facts.iter().map(|(name, value)| fact(name, value)).collect();
    format!(
        "<h1>{}</h1><p class=\"headline\">{}</p><dl class=\"facts\">{facts}</dl>\
         <details><summary>options and versions</summary><dl class=\"facts\">{}{}</dl></details>",
        html(&header.run),
        headline(results),
        facts_of(&header.options),
        facts_of(&header.versions),
    )
}

fn fact(name: &str, value: &str) -> String {
    format!("<div><dt>{}</dt><dd>{}</dd></div>", html(name), html(value))
}

fn facts_of(value: &Value) -> String {
    let Value::Object(fields) = value else { return fact("value", &value.to_string()) };
    let plain = |value: &Value| match value {
        Value::String(text) => text.clone(),
        Value::Array(list) => list.iter().map(plain_item).collect::<Vec<_>>().join(", "),
        other => other.to_string(),
    };
    fields.iter().map(|(name, value)| fact(name, &plain(value))).collect()
}

fn plain_item(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// One sentence: the verifier against one sample, or the first setting alone.
fn headline(results: &Results) -> String {
    let main = results.gains.iter().find(|gain| {
        gain.better.strategy == Strategy::Verifier && gain.worse.strategy == Strategy::Sample
    });
    let setting = |setting| results.settings.iter().find(|result| result.setting == setting);
    let Some(main) = main else {
        return results.settings.first().map_or_else(String::new, |first| {
            format!(
                "{} succeeds in {}.",
                html(&first.setting.to_string()),
                percent(first.all.success)
            )
        });
    };
    let (Some(better), Some(worse)) = (setting(main.better), setting(main.worse)) else {
        return String::new();
    };
    let class = if main.gain.mean < 0.0 { " class=\"worse\"" } else { "" };
    format!(
        "The verifier’s choice of {} succeeds in {}, one sample at the same temperature in {}: a paired \
         gain of <b{class}>{:+.1} points</b> (95 % interval {:+.1} to {:+.1}, {} pairs).",
        main.better.candidates,
        percent(better.all.success),
        percent(worse.all.success),
        main.gain.mean * 100.0,
        main.gain.interval.low * 100.0,
        main.gain.interval.high * 100.0,
        main.gain.pairs
    )
}

fn percent(rate: Rate) -> String {
    rate.value().map_or_else(|| "–".to_owned(), |value| format!("{:.1} %", value * 100.0))
}

fn percent_with_interval(rate: Rate) -> String {
    let Some(value) = rate.value() else { return "–".to_owned() };
    let interval = rate.interval();
    format!(
        "{:.1}<small>{:.1}–{:.1}</small>",
        value * 100.0,
        interval.low * 100.0,
        interval.high * 100.0
    )
}

fn result(results: &Results) -> String {
    let heads: String =
        results.tasks.iter().map(|task| format!("<th>{}</th>", html(&task_words(task)))).collect();
    let rows: String = results.settings.iter().map(row).collect();
    format!(
        "<p class=\"note\">Percent of episodes with 95 % Wilson intervals. Success is read at the last \
         step; the columns on the right count, over all tasks, success at any step, success with the \
         object let go, and episodes in which the object was held at some step.</p>\
         <div class=\"scroll\"><table><thead><tr><th>strategy</th><th>success</th>{heads}\
         <th>at any step</th><th>released</th><th>grasp</th><th>n</th><th>faults</th></tr></thead>\
         <tbody>{rows}</tbody></table></div>"
    )
}

fn row(result: &SettingResult) -> String {
    let Rates { grasped, success, ever_success, released_success, faults } = result.all;
    let tasks: String = result.tasks.iter().map(|task| cell(task.success)).collect();
    let class = if faults > 0 { " class=\"fault\"" } else { "" };
    format!(
        "<tr data-strategy=\"{}\"><td>{}</td><td class=\"main\">{}</td>{tasks}{}{}{}<td>{}</td>\
         <td{class}>{faults}</td></tr>",
        result.setting.strategy,
        html(&result.setting.to_string()),
        percent_with_interval(success),
        cell(ever_success),
        cell(released_success),
        cell(grasped),
        success.trials
    )
}

fn cell(rate: Rate) -> String {
    format!("<td>{}</td>", percent_with_interval(rate))
}

fn gains(results: &Results) -> String {
    let comparison = |gain: &SettingGain| Comparison {
        label: format!("{} − {}", gain.better, gain.worse),
        episodes: gain.gain.pairs,
        gain: gain.gain.mean,
        low: gain.gain.interval.low,
        high: gain.gain.interval.high,
    };
    let comparisons: Vec<Comparison> = results.gains.iter().map(comparison).collect();
    let figure = forest::figure(&comparisons);
    if figure.is_empty() {
        return figure;
    }
    let headroom: Vec<String> = results
        .headroom
        .iter()
        .map(|one| format!("{} {:.0} %", html(&one.setting.to_string()), one.fraction * 100.0))
        .collect();
    let headroom = match headroom.is_empty() {
        true => String::new(),
        false => format!(
            "<p class=\"note\">Part of the way from one sample to the oracle: {}.</p>",
            headroom.join(", ")
        ),
    };
    format!(
        "<p class=\"note\">Points of success on the same layouts with the same random numbers, \
         averaged over tasks; 95 % paired bootstrap intervals.</p>{figure}{headroom}"
    )
}

fn candidates(results: &Results) -> String {
    let mut series: Vec<(Strategy, f32, Series)> = Vec::new();
    for result in results.settings.iter().filter(|result| result.setting.candidates > 1) {
        let (strategy, temperature) = (result.setting.strategy, result.setting.temperature);
        let known = series.iter().position(|(a, b, _)| (*a, *b) == (strategy, temperature));
        let place = known.unwrap_or_else(|| {
            // Choosing from one candidate is taking one sample, so every line begins there.
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
    // A line needs a second number of candidates beside the one sample that all share.
    series.retain(|(_, _, one)| one.points.iter().filter(|point| point.candidates > 1).count() > 1);
    let figure = curve::figure(&series.into_iter().map(|(_, _, one)| one).collect::<Vec<_>>());
    if figure.is_empty() {
        return figure;
    }
    format!(
        "<p class=\"note\">Success at the last step over all tasks, with 95 % Wilson intervals; one \
         candidate is one sample.</p>{figure}"
    )
}

fn point(result: &SettingResult) -> Option<Point> {
    let interval = result.all.success.interval();
    Some(Point {
        candidates: result.setting.candidates as usize,
        rate: result.all.success.value()?,
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
    let interval = rate.interval();
    Some(Bar {
        label: result.setting.to_string(),
        strategy: result.setting.strategy.to_string(),
        rate: rate.value()?,
        low: interval.low,
        high: interval.high,
        episodes: rate.trials as usize,
    })
}
