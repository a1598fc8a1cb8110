//! Tests of what a terminal shows.

use super::*;
use crate::report::sample;
use crate::results::{Results, tasks_in_order};
use serde_json::json;

fn shown() -> String {
    let order = tasks_in_order(&json!({"tasks": sample::TASKS}));
    text(&Results::new(&sample::summaries(), &[], &order).expect("results"))
}

#[test]
fn columns_are_aligned_whatever_they_hold() {
    let rows = [vec!["a", "success %"], vec!["title"], vec!["  longer", "–", "9"]];
    let rows = rows.map(|row| row.into_iter().map(str::to_owned).collect::<Vec<_>>());
    assert_eq!(aligned(&rows), "a         success %\ntitle\n  longer          –  9\n");
}

#[test]
fn the_answer_comes_first_and_every_setting_tells_its_malformed_candidates() {
    let text = shown();
    assert!(text.starts_with("The verifier's choice among 5 candidates"), "{text}");
    let counts = text.split("Beside the rates").nth(1).expect("counts");
    for setting in ["greedy", "sample T=1", "verifier N=5 T=1"] {
        let row = counts.lines().find(|line| line.trim_start().starts_with(setting));
        let row = row.unwrap_or_else(|| panic!("a row of {setting}: {text}"));
        assert!(row.matches(" of ").count() == 2, "malformed candidates and held steps: {row}");
    }
    assert!(text.contains("averaged over tasks, each of which counts the same"), "{text}");
    assert!(text.contains("decision (batches of 4)"), "{text}");
}

#[test]
fn tables_fit_a_terminal_of_100_columns() {
    for line in shown().lines().filter(|line| line.matches("  ").count() > 1) {
        assert!(line.chars().count() <= 100, "{line}");
    }
}
