//! The head of the page: what the run shows, its main figures, and the command that made it.

use store::run::RunHeader;

use super::escape::html;
use super::glossary::term_as;
use super::provenance::{command_line, date};
use crate::headline::Headline;
use crate::results::{Counts, Results, StepTime};

/// Name and date, headline, facts, command line.
pub fn head(header: &RunHeader, results: &Results) -> String {
    let made = header.starts.last().map_or_else(String::new, |start| {
        format!(
            "<span>{}</span><span>commit <code>{}</code></span><span class=\"command\"><code class=\"copy\" title=\"{2}\">{2}</code></span>",
            html(&date(&start.time)),
            html(&start.build.commit_text()),
            html(&command_line(&start.command))
        )
    });
    format!(
        "<div class=\"run\"><h1>{}</h1>{made}</div><p class=\"headline\">{}</p><dl class=\"facts\">{}</dl>",
        html(&header.run),
        headline(results),
        facts(results),
    )
}

fn headline(results: &Results) -> String {
    let Some(Headline { statement, gain, remark }) = Headline::new(results) else {
        return String::new();
    };
    let gain = gain.map_or_else(String::new, |gain| {
        let class = if gain.starts_with(['-', '−']) { " class=\"worse\"" } else { "" };
        format!(" <b{class}>{}</b>", html(&gain.replace('-', "−")))
    });
    let remark = remark.replace(" -", " −");
    format!("{}{gain} <span class=\"remark\">{}</span>", html(&statement), html(&remark))
}

fn facts(results: &Results) -> String {
    let total = |of: fn(&Counts) -> u64| -> u64 {
        results.settings.iter().map(|setting| of(&setting.all.counts)).sum()
    };
    let mut facts = vec![
        fact("episodes", results.counted.len().to_string()),
        fact(&term_as("fault", "faults"), total(|counts| counts.faults).to_string()),
    ];
    for (name, count) in [
        (term_as("malformed", "malformed candidates"), total(|counts| counts.malformed)),
        ("steps held still".to_owned(), total(|counts| counts.held_steps)),
        ("policy never acted".to_owned(), total(|counts| counts.never_acted)),
    ] {
        if count > 0 {
            facts.push(fact(&name, count.to_string()));
        }
    }
    let batch =
        results.batch_size.map_or_else(String::new, |size| format!(" in batches of {size:.0}"));
    for (name, time, how) in [
        ("time per decision", results.decision_ms, batch),
        ("time per step", results.step_ms, String::new()),
    ] {
        if let Some(StepTime { p50, p95 }) = time {
            facts.push(fact(name, format!("{p50:.1} ms{how} (95th percentile {p95:.1})")));
        }
    }
    facts.concat()
}

/// `name` is HTML already.
fn fact(name: &str, value: String) -> String {
    format!("<div><dt>{name}</dt><dd>{}</dd></div>", html(&value))
}
