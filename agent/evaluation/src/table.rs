//! The tables that a terminal shows: success of every setting on every task, gains, success against N.

use std::fmt::Write;

use crate::results::{Rates, Results, SettingResult, StepTime};
use crate::statistics::Rate;
use decision::Strategy;

/// All tables, one after the other. Every percentage carries its number of episodes or its interval.
pub fn text(results: &Results) -> String {
    let parts = [rates(results), gains(results), by_candidates(results), times(results)];
    parts.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("\n")
}

/// One block per task and one for all: SIMPLER's result first, the other readings of success beside it.
fn rates(results: &Results) -> String {
    let mut rows = vec![
        ["", "success %", "95 %", "grasp %", "95 %", "any step %", "released %", "n", "faults"]
            .map(str::to_owned)
            .to_vec(),
    ];
    let blocks =
        results.tasks.iter().enumerate().map(|(index, task)| (task.to_string(), Some(index)));
    for (title, index) in blocks.chain([("average".to_owned(), None)]) {
        rows.push(vec![title]);
        for result in &results.settings {
            rows.push(rate_row(result, index.map_or(&result.all, |index| &result.tasks[index])));
        }
    }
    aligned(&rows)
}

fn rate_row(result: &SettingResult, rates: &Rates) -> Vec<String> {
    vec![
        format!("  {}", result.setting),
        percent(rates.success),
        interval(rates.success),
        percent(rates.grasped),
        interval(rates.grasped),
        percent(rates.ever_success),
        percent(rates.released_success),
        rates.success.trials.to_string(),
        rates.faults.to_string(),
    ]
}

fn gains(results: &Results) -> String {
    if results.gains.is_empty() {
        return String::new();
    }
    let mut rows =
        vec![["gain in points, paired", "", "95 %", "pairs"].map(str::to_owned).to_vec()];
    for gain in &results.gains {
        let interval = gain.gain.interval;
        rows.push(vec![
            format!("  {} over {}", gain.better, gain.worse),
            format!("{:+.1}", 100.0 * gain.gain.mean),
            format!("[{:+.1}, {:+.1}]", 100.0 * interval.low, 100.0 * interval.high),
            gain.gain.pairs.to_string(),
        ]);
    }
    for headroom in &results.headroom {
        let title =
            format!("  {}: part of the way from one sample to the oracle", headroom.setting);
        rows.push(vec![title, format!("{:.0} %", 100.0 * headroom.fraction)]);
    }
    aligned(&rows)
}

/// Where a strategy ran with several numbers of candidates; one sample is its first point.
fn by_candidates(results: &Results) -> String {
    let mut rows =
        vec![["success against N", "N", "success %", "95 %"].map(str::to_owned).to_vec()];
    for strategy in Strategy::ALL {
        let of_strategy = |result: &&SettingResult| result.setting.strategy == strategy;
        let mut temperatures: Vec<f32> = results
            .settings
            .iter()
            .filter(of_strategy)
            .map(|result| result.setting.temperature)
            .collect();
        temperatures.dedup();
        for temperature in temperatures {
            let is_point = |result: &&SettingResult| {
                result.setting.temperature == temperature
                    && [strategy, Strategy::Sample].contains(&result.setting.strategy)
            };
            let points: Vec<&SettingResult> = results.settings.iter().filter(is_point).collect();
            if points.iter().filter(|result| of_strategy(result)).count() < 2 {
                continue;
            }
            for point in points {
                rows.push(vec![
                    format!("  {strategy} T={temperature}"),
                    point.setting.candidates.to_string(),
                    percent(point.all.success),
                    interval(point.all.success),
                ]);
            }
        }
    }
    if rows.len() == 1 { String::new() } else { aligned(&rows) }
}

fn interval(rate: Rate) -> String {
    let interval = rate.interval();
    format!("[{:.1}, {:.1}]", 100.0 * interval.low, 100.0 * interval.high)
}

fn times(results: &Results) -> String {
    let times = [
        ("  decision of a whole batch", results.decision_ms),
        ("  control step after it", results.step_ms),
        ("    its simulator's part", results.simulator_ms),
    ];
    let mut rows = vec![["milliseconds", "p50", "p95"].map(str::to_owned).to_vec()];
    for (what, time) in times {
        if let Some(StepTime { p50, p95 }) = time {
            rows.push(vec![what.to_owned(), format!("{p50:.1}"), format!("{p95:.1}")]);
        }
    }
    if rows.len() == 1 { String::new() } else { aligned(&rows) }
}

fn percent(rate: Rate) -> String {
    rate.value().map_or_else(|| "-".to_owned(), |value| format!("{:.1}", 100.0 * value))
}

/// The first column to the left, the others to the right.
pub fn aligned(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let cells = |column: usize| rows.iter().filter_map(move |row| row.get(column));
    let widths: Vec<usize> = (0..columns)
        .map(|column| cells(column).map(|cell| cell.chars().count()).max().unwrap_or(0))
        .collect();
    let mut text = String::new();
    for row in rows {
        let mut line = String::new();
        for (column, (cell, width)) in row.iter().zip(&widths).enumerate() {
            // Writing to a string cannot fail.
            let _ = match column {
                0 => write!(line, "{cell:width$}"),
                _ => write!(line, "  {cell:>width$}"),
            };
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_aligned_whatever_they_hold() {
        let rows = [vec!["a", "success %"], vec!["title"], vec!["  longer", "–", "9"]];
        let rows = rows.map(|row| row.into_iter().map(str::to_owned).collect::<Vec<_>>());
        assert_eq!(aligned(&rows), "a         success %\ntitle\n  longer          –  9\n");
    }
}
