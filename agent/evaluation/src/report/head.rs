//! The head of the page: what the run shows, its main figures, options and versions.

use std::collections::BTreeSet;

use serde_json::Value;
use store::run::{RunHeader, RunStart};

use super::escape::html;
use crate::headline::Headline;
use crate::results::{Counts, Results, StepTime};

/// A digest is known by its beginning.
const VERSION_LETTERS: usize = 16;

/// Name, headline, facts, and all options, versions and command lines to unfold.
pub fn head(header: &RunHeader, simulators: &BTreeSet<String>, results: &Results) -> String {
    format!(
        "<h1>{}</h1><p class=\"headline\">{}</p><dl class=\"facts\">{}</dl>\
         <details><summary>options, versions and command lines</summary><dl class=\"facts\">{}</dl></details>",
        html(&header.run),
        headline(results),
        main_facts(header, simulators, results),
        all_facts(header),
    )
}

fn headline(results: &Results) -> String {
    let Some(Headline { statement, gain, remark }) = Headline::new(results) else {
        return String::new();
    };
    let gain = gain.map_or_else(String::new, |gain| {
        let class = if gain.starts_with('-') { " class=\"worse\"" } else { "" };
        format!(" <b{class}>{}</b>", html(&gain))
    });
    format!("{}{gain} {}", html(&statement), html(&remark))
}

fn main_facts(header: &RunHeader, simulators: &BTreeSet<String>, results: &Results) -> String {
    let total = |of: fn(&Counts) -> u64| {
        results.settings.iter().map(|setting| of(&setting.all.counts)).sum::<u64>().to_string()
    };
    let mut facts = vec![
        ("episodes", results.counted.len().to_string()),
        ("faults", total(|counts| counts.faults)),
        ("policy never acted", total(|counts| counts.never_acted)),
        ("malformed candidates", total(|counts| counts.malformed)),
        ("held steps", total(|counts| counts.held_steps)),
    ];
    let batch =
        results.batch_size.map_or_else(String::new, |size| format!(" in batches of {size:.0}"));
    let times = [
        ("a decision takes", results.decision_ms, batch),
        ("a step takes", results.step_ms, String::new()),
        ("its simulator takes", results.simulator_ms, String::new()),
    ];
    for (what, time, how) in times {
        if let Some(StepTime { p50, p95 }) = time {
            facts.push((what, format!("{p50:.1} ms{how} (p95 {p95:.1} ms)")));
        }
    }
    let simulators: Vec<&str> = simulators.iter().map(String::as_str).collect();
    facts.push(("simulator", simulators.join(", ")));
    for name in ["policy", "verifier"] {
        if let Some(version) = header.versions.get(name).and_then(Value::as_str) {
            facts.push((name, version.chars().take(VERSION_LETTERS).collect()));
        }
    }
    facts.iter().map(|(name, value)| fact(name, value)).collect()
}

/// Options and versions one by one, then the command lines and builds that made the run.
fn all_facts(header: &RunHeader) -> String {
    let objects = [&header.options, &header.versions].map(Value::as_object).into_iter().flatten();
    let named = objects.flatten().map(|(name, value)| fact_of(name, value));
    let starts = header.starts.iter().map(|RunStart { time, command, build }| {
        fact(&format!("started {time}"), &format!("{} with {build}", command.join(" ")))
    });
    named.chain(starts).collect()
}

/// Nothing for an option that is not set.
fn fact_of(name: &str, value: &Value) -> String {
    let plain = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    match value {
        Value::Null => String::new(),
        Value::Array(list) => fact(name, &list.iter().map(plain).collect::<Vec<_>>().join(", ")),
        value => fact(name, &plain(value)),
    }
}

fn fact(name: &str, value: &str) -> String {
    format!("<div><dt>{}</dt><dd>{}</dd></div>", html(name), html(value))
}
