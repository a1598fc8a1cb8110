//! All tables of a run: rates, gains, headroom, counts and times.

use decision::Strategy;

use super::{aligned, episodes, percent, signed, with_interval};
use crate::results::{Counts, Results, SettingResult, StepTime};
use crate::statistics::Interval;

/// All tables. Every percentage has its interval or its number of episodes.
pub fn text(results: &Results) -> String {
    let parts = [
        averages(results),
        tasks(results),
        gains(results),
        headroom(results),
        by_candidates(results),
        counts(results),
        times(results),
    ];
    parts.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join("\n")
}

/// A title, the table and a note; nothing without rows.
fn titled(title: &str, head: &[&str], rows: Vec<Vec<String>>, note: &str) -> String {
    if rows.is_empty() {
        return String::new();
    }
    let head = head.iter().map(|name| (*name).to_owned()).collect();
    let rows: Vec<Vec<String>> = std::iter::once(head).chain(rows).collect();
    let note = if note.is_empty() { String::new() } else { format!("{note}\n") };
    format!("{title}\n{}{note}", aligned(&rows))
}

fn averages(results: &Results) -> String {
    let row = |result: &SettingResult| {
        vec![
            format!("  {}", result.setting),
            with_interval(result.all.success),
            percent(result.all.ever_success),
            percent(result.all.released_success),
            percent(result.all.grasped),
            episodes(result.all.success),
        ]
    };
    let clustered =
        results.settings.iter().any(|one| one.all.success.episodes > one.all.success.starts);
    let note = match clustered {
        true => {
            "  Intervals account for clusters: episodes that share an initial layout are not independent."
        }
        false => "",
    };
    titled(
        "Success in % of episodes, averaged over tasks with equal weight; 95 % intervals",
        &["", "at the last step", "at any step", "released", "ever grasped", "episodes"],
        results.settings.iter().map(row).collect(),
        note,
    )
}

fn tasks(results: &Results) -> String {
    if results.tasks.len() < 2 {
        return String::new();
    }
    let mut rows = Vec::new();
    for (index, task) in results.tasks.iter().enumerate() {
        rows.push(vec![format!("  {task}")]);
        for result in &results.settings {
            let of_task = &result.tasks[index];
            rows.push(vec![
                format!("    {}", result.setting),
                with_interval(of_task.success),
                percent(of_task.released_success),
                percent(of_task.grasped),
                malformed(of_task.counts),
                episodes(of_task.success),
            ]);
        }
    }
    titled(
        "Success per task in % of episodes, and malformed candidates in % of all",
        &["", "at the last step", "released", "ever grasped", "malformed", "episodes"],
        rows,
        "",
    )
}

fn gains(results: &Results) -> String {
    let rows = results.gains.iter().map(|one| {
        let gain = &one.gain;
        vec![
            format!("  {} minus {}", one.better, one.worse),
            format!("{:+.1}", 100.0 * gain.mean),
            signed(gain.interval),
            gain.pairs.to_string(),
        ]
    });
    titled(
        "Gains in percentage points, on the same initial layouts with the same random numbers",
        &["", "gain", "95 %", "pairs"],
        rows.collect(),
        "  If an interval includes 0, it is not clear which of the two is better.",
    )
}

fn headroom(results: &Results) -> String {
    let rows = results.headroom.iter().map(|one| {
        let headroom = &one.headroom;
        vec![
            format!("  {}", one.setting),
            format!("{:.0} %", 100.0 * headroom.fraction),
            headroom.interval.map_or_else(|| "open".to_owned(), rounded),
            headroom.episodes.to_string(),
        ]
    });
    titled(
        "Headroom: share of the gap between a single sample and the oracle that a setting closes",
        &["", "share", "95 %", "episodes"],
        rows.collect(),
        "  The oracle executes the candidate nearest to the scripted expert's action.\n  \
         Open: the oracle may be no better than a single sample.",
    )
}

/// The strategies that ran with several numbers of candidates. A single sample is the first point of each.
fn by_candidates(results: &Results) -> String {
    let mut rows = Vec::new();
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
            rows.extend(points.into_iter().map(|point| {
                vec![
                    format!("  {strategy} T={temperature}"),
                    point.setting.candidates.to_string(),
                    with_interval(point.all.success),
                ]
            }));
        }
    }
    titled("Success against the number of candidates N", &["", "N", "at the last step"], rows, "")
}

fn counts(results: &Results) -> String {
    let row = |result: &SettingResult| {
        let Counts { faults, never_acted, repeats, proposed, malformed, decisions, held_steps } =
            result.all.counts;
        vec![
            format!("  {}", result.setting),
            format!("{malformed} of {proposed}"),
            format!("{held_steps} of {decisions}"),
            never_acted.to_string(),
            faults.to_string(),
            repeats.to_string(),
        ]
    };
    titled(
        "Counts",
        &["", "malformed candidates", "held steps", "never acted", "faults", "repeats"],
        results.settings.iter().map(row).collect(),
        "  Malformed candidates are never executed; without a well-formed one the robot holds still.\n  \
         Episodes in which the policy never acted and failed attempts (faults) have no outcome.\n  \
         Repeats of an episode without sampling count once.",
    )
}

fn times(results: &Results) -> String {
    let batch =
        results.batch_size.map_or_else(String::new, |size| format!(" (batches of {size:.0})"));
    let times = [
        (format!("  decision{batch}"), results.decision_ms),
        ("  control step".to_owned(), results.step_ms),
        ("    of that, the simulator".to_owned(), results.simulator_ms),
    ];
    let rows = times.into_iter().filter_map(|(what, time)| {
        let StepTime { p50, p95 } = time?;
        Some(vec![what, format!("{p50:.1}"), format!("{p95:.1}")])
    });
    titled("Milliseconds", &["", "median", "p95"], rows.collect(), "")
}

fn malformed(counts: Counts) -> String {
    match counts.proposed {
        0 => "-".to_owned(),
        proposed => format!("{:.1}", 100.0 * counts.malformed as f64 / proposed as f64),
    }
}

fn rounded(interval: Interval) -> String {
    format!("[{:.0}, {:.0}]", 100.0 * interval.low, 100.0 * interval.high)
}
