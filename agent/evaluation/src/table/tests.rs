//! Tests of the tables in a terminal.

use super::*;
use crate::report::sample;
use crate::results::{Results, tasks_in_order};
use serde_json::json;

fn results() -> Results {
    let order = tasks_in_order(&json!({"tasks": sample::TASKS}));
    Results::new(&sample::summaries(), &[], &order).expect("results")
}

#[test]
fn columns_are_aligned_whatever_they_hold() {
    let rows = [vec!["a", "success %"], vec!["title"], vec!["  longer", "–", "9"]];
    let rows = rows.map(|row| row.into_iter().map(str::to_owned).collect::<Vec<_>>());
    assert_eq!(aligned(&rows), "a         success %\ntitle\n  longer          –  9\n");
}

#[test]
fn every_setting_tells_its_malformed_candidates() {
    let text = details::text(&results());
    let counts = text.split("\nCounts\n").nth(1).expect("counts");
    for setting in ["greedy", "sample T=1", "verifier N=5 T=1"] {
        let row = counts.lines().find(|line| line.trim_start().starts_with(setting));
        let row = row.unwrap_or_else(|| panic!("a row of {setting}: {text}"));
        assert!(row.matches(" of ").count() == 2, "malformed candidates and held steps: {row}");
    }
    assert!(text.contains("averaged over tasks with equal weight"), "{text}");
    assert!(text.contains("decision (batches of 4)"), "{text}");
}

#[test]
fn the_answer_comes_first_and_fits_the_terminal() {
    for columns in [60, COLUMNS_DEFAULT] {
        let text = answer(&results(), columns);
        assert!(text.starts_with("The verifier's choice among 5 candidates"), "{text}");
        for line in text.lines() {
            assert!(
                line.chars().count() <= columns,
                "{} > {columns}: {line}",
                line.chars().count()
            );
        }
    }
}

#[test]
fn details_fit_a_terminal_of_100_columns() {
    for line in details::text(&results()).lines() {
        assert!(line.chars().count() <= 100, "{line}");
    }
}

#[test]
fn an_open_gain_tells_how_many_pairs_would_settle_it() {
    let gain = |mean: f64, half_width: f64, pairs| crate::estimate::Gain {
        mean,
        interval: Interval { low: mean - half_width, high: mean + half_width },
        better_rate: 0.5 + mean,
        worse_rate: 0.5,
        pairs,
        starts: pairs,
    };
    // Twice the pairs of a gain that is just clear have 80 % power: (2.80 / 1.96)^2 = 2.04.
    assert_eq!(gain(0.1, 0.1001, 100).pairs_to_tell(), Some(210));
    assert_eq!(gain(0.1, 0.2, 24).pairs_to_tell(), Some(200));
    assert_eq!(gain(0.1, 0.05, 24).pairs_to_tell(), None, "clear");
    assert_eq!(gain(0.0, 0.2, 24).pairs_to_tell(), None, "nothing gained");
}
