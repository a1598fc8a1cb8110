//! The results of a run in a terminal: the answer first, then its rates and gains. Everything else is in [`details`].

pub mod details;

use comfy_table::{CellAlignment, Table, presets};
use decision::{Setting, Strategy};

use crate::comparisons::SettingGain;
use crate::estimate::Rate;
use crate::headline::Headline;
use crate::results::{Counts, Results, SettingResult};
use crate::statistics::Interval;
use crate::task_names::short_names;

/// Default width of a terminal in columns.
pub const COLUMNS_DEFAULT: usize = 80;

/// The answer, at most `columns` wide if possible.
pub fn answer(results: &Results, columns: usize) -> String {
    let headline =
        Headline::new(results).map_or_else(String::new, |one| wrapped(&one.text(), columns));
    let parts =
        [headline, rates(results, columns), gains(results, columns), remarks(results, columns)];
    parts.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("\n")
}

/// Success of every setting, over all tasks and on each task.
fn rates(results: &Results, columns: usize) -> String {
    let names = short_names(&results.tasks);
    let episodes = common(results.settings.iter().map(|one| episodes(one.all.success)));
    let mut head = vec![String::new(), "all tasks".to_owned()];
    head.extend(names.iter().cloned());
    if episodes.is_none() {
        head.push("episodes".to_owned());
    }
    let row = |result: &SettingResult| {
        let mut row = vec![format!("  {}", result.setting), with_interval(result.all.success)];
        row.extend(result.tasks.iter().map(|task| whole_percent(task.success)));
        if episodes.is_none() {
            row.push(self::episodes(result.all.success));
        }
        row
    };
    let mut rows: Vec<Vec<String>> =
        std::iter::once(head).chain(results.settings.iter().map(row)).collect();
    if results.tasks.len() < 2 || is_wider(&rows, columns) {
        rows.iter_mut().for_each(|row| drop(row.drain(2..2 + names.len())));
    }
    let each = episodes.map_or_else(String::new, |count| format!(", n = {count} each"));
    format!("Success at the last step in %, 95 % intervals{each}\n{}", aligned(&rows))
}

/// Paired gains, each with a verdict.
fn gains(results: &Results, columns: usize) -> String {
    if results.gains.is_empty() {
        return String::new();
    }
    let row = |one: &SettingGain| {
        let SettingGain { better, worse, gain } = one;
        let verdict = match gain.is_clear() {
            true => String::new(),
            false => "not clear".to_owned(),
        };
        vec![
            format!("  {} - {}", better, within(*worse, *better)),
            format!("{:+.1} {}", 100.0 * gain.mean, signed(gain.interval)),
            gain.pairs.to_string(),
            verdict,
        ]
    };
    let head = ["", "gain [95 % interval]", "pairs", ""].map(str::to_owned).to_vec();
    let mut rows: Vec<Vec<String>> =
        std::iter::once(head).chain(results.gains.iter().map(row)).collect();
    // In a narrow terminal the verdict and the pairs are dropped: the intervals and the rates imply them.
    for _ in 0..2 {
        if is_wider(&rows, columns) {
            rows.iter_mut().for_each(|row| drop(row.pop()));
        }
    }
    let table = aligned(&rows);
    let table: String = table.lines().map(|line| format!("{}\n", line.trim_end())).collect();
    format!("Gains in percentage points, on the same initial layouts\n{table}")
}

fn is_wider(rows: &[Vec<String>], columns: usize) -> bool {
    aligned(rows).lines().any(|line| line.trim_end().chars().count() > columns)
}

/// A setting without the values that it shares with another.
fn within(setting: Setting, beside: Setting) -> String {
    let Setting { strategy, candidates, temperature } = setting;
    let mut text = strategy.to_string();
    let proposes_one = matches!(strategy, Strategy::Greedy | Strategy::Sample);
    if candidates != beside.candidates && !proposes_one {
        text.push_str(&format!(" N={candidates}"));
    }
    if temperature != beside.temperature && strategy != Strategy::Greedy {
        text.push_str(&format!(" T={temperature}"));
    }
    text
}

/// Remarks on faults, held episodes and malformed candidates, if there are any, and on the names of settings.
fn remarks(results: &Results, columns: usize) -> String {
    let Counts { faults, never_acted, proposed, malformed, decisions, held_steps, .. } =
        results.settings.iter().map(|one| one.all.counts).fold(Counts::default(), Counts::plus);
    let mut lines = Vec::new();
    if faults > 0 {
        lines.push(format!("Faults: {faults} attempts failed and do not count in any rate."));
    }
    if never_acted > 0 {
        lines.push(format!(
            "{never_acted} episodes without any well-formed candidate have no outcome: the robot held still."
        ));
    }
    if malformed > 0 {
        lines.push(format!(
            "Malformed candidates: {malformed} of {proposed}; the robot held still in {held_steps} of {decisions} steps."
        ));
    }
    if results.settings.iter().any(|one| one.setting.strategy == Strategy::Sample) {
        lines.push(
            "sample: a single candidate (N = 1). verifier N=5: the best of five by score."
                .to_owned(),
        );
    }
    lines.iter().map(|line| wrapped(line, columns)).collect()
}

/// The common text, if all texts are equal.
fn common(texts: impl Iterator<Item = String>) -> Option<String> {
    let mut texts: Vec<String> = texts.collect();
    texts.dedup();
    (texts.len() == 1).then(|| texts.remove(0))
}

/// Wraps text between words to lines of at most this many columns.
pub fn wrapped(text: &str, columns: usize) -> String {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= columns => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines.iter().map(|line| format!("{line}\n")).collect()
}

/// Number of episodes of a rate, and of initial layouts if there are fewer.
fn episodes(rate: Rate) -> String {
    match rate.episodes == rate.starts {
        true => rate.episodes.to_string(),
        false => format!("{} on {} layouts", rate.episodes, rate.starts),
    }
}

fn percent(rate: Rate) -> String {
    rate.value.map_or_else(|| "-".to_owned(), |value| format!("{:.1}", 100.0 * value))
}

fn whole_percent(rate: Rate) -> String {
    rate.value.map_or_else(|| "-".to_owned(), |value| format!("{:.0}", 100.0 * value))
}

fn with_interval(rate: Rate) -> String {
    let Interval { low, high } = rate.interval;
    format!("{} [{:.1}, {:.1}]", percent(rate), 100.0 * low, 100.0 * high)
}

fn signed(interval: Interval) -> String {
    format!("[{:+.1}, {:+.1}]", 100.0 * interval.low, 100.0 * interval.high)
}

/// Columns of numbers: the first column to the left, the others to the right.
pub fn aligned(rows: &[Vec<String>]) -> String {
    aligned_to(rows, CellAlignment::Right)
}

/// Columns of text.
pub fn aligned_left(rows: &[Vec<String>]) -> String {
    aligned_to(rows, CellAlignment::Left)
}

fn aligned_to(rows: &[Vec<String>], others: CellAlignment) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING).add_rows(rows);
    for (index, column) in table.column_iter_mut().enumerate() {
        // Two spaces between columns, none before the first.
        column.set_padding((if index == 0 { 0 } else { 2 }, 0));
        column.set_cell_alignment(if index == 0 { CellAlignment::Left } else { others });
    }
    table.trim_fmt() + "\n"
}

#[cfg(test)]
mod tests;
