//! The output and the errors of `rever bench`. No test checks how fast anything is.

use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::harness::{repository, rever, run, succeed, text};

#[test]
fn a_benchmark_of_decisions_prints_a_table_and_writes_the_same_figures() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("bench.json");
    let mut bench = rever();
    bench.args(["bench", "decision", "--rounds", "1", "--json"]).arg(&file);
    let table = succeed(&mut bench);
    let report: Value =
        serde_json::from_slice(&std::fs::read(&file).expect("the figures")).expect("JSON");
    let head = succeed(Command::new("git").current_dir(repository()).args(["rev-parse", "HEAD"]));
    let commit = report["commit"].as_str().expect("a commit").trim_end_matches("-dirty");
    assert!(head.starts_with(commit) && commit.len() >= 7, "{commit}");
    let rows = report["rows"].as_array().expect("rows");
    let candidates: Vec<_> = rows.iter().map(|row| row["candidates"].as_u64()).collect();
    assert_eq!(candidates, [1, 1, 2, 5, 8, 16].map(Some));
    for row in rows {
        let figure = |name: &str| row[name].as_f64().expect("a number");
        assert!(figure("decision_ms_p50") > 0.0 && figure("bandwidth_share") > 0.0, "{row}");
        assert!(table.contains(&format!("{:.1}", figure("decision_ms_p95"))), "{table}");
    }
    assert!(report["ratio_greedy"].is_number() && report["ratio_eager"].is_null(), "{report}");
}

#[test]
fn a_benchmark_of_throughput_counts_decisions_at_every_number_of_sessions() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("bench.json");
    let mut bench = rever();
    bench.args(["bench", "throughput", "--sessions", "1,3", "--decisions", "70", "--json"]);
    let table = succeed(bench.arg(&file));
    let rows = rows(&file);
    let sessions: Vec<_> = rows.iter().map(|row| row["sessions"].as_u64()).collect();
    assert_eq!(sessions, [1, 3].map(Some));
    for row in rows {
        let figure = |name: &str| row[name].as_f64().expect("a number");
        assert!(figure("decisions") >= 70.0 && figure("decisions_per_second") > 0.0, "{row}");
        assert!(figure("memory_mb_after") > 1.0, "{row}");
        assert!(table.contains(&format!("{:.1}", figure("decisions_per_second"))), "{table}");
    }
}

#[test]
fn a_benchmark_of_the_wire_takes_the_simulator_out_of_a_step() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("bench.json");
    let mut bench = rever();
    bench.args(["bench", "wire", "--sessions", "1,5", "--steps", "60", "--side", "64", "--json"]);
    let table = succeed(bench.arg(&file));
    let rows = rows(&file);
    let counts: Vec<_> =
        rows.iter().map(|row| (row["simulator"].as_str(), row["steps"].as_u64())).collect();
    // 60 steps per session; an episode that ends is followed by a new one.
    let expected = [("native", 60), ("native", 300), ("python", 60), ("python", 300)];
    assert_eq!(counts, expected.map(|(simulator, steps)| (Some(simulator), Some(steps))));
    for row in rows {
        let figure = |name: &str| row[name].as_f64().expect("a number");
        for name in ["step", "simulator", "wire", "repeat", "bare"] {
            let name = format!("{name}_ms_p50");
            let figure = figure(&name);
            assert!(figure > 0.0, "{row}");
            // serde_json reads a number within one unit of its last place, which can turn a half.
            let is_printed = |off: f64| table.contains(&format!("{:.3}", figure + off));
            assert!([-1e-9, 0.0, 1e-9].into_iter().any(is_printed), "{figure}: {table}");
        }
    }
}

fn rows(file: &Path) -> Vec<Value> {
    let figures = std::fs::read(file).expect("the figures");
    let figures: Value = serde_json::from_slice(&figures).expect("JSON");
    figures["rows"].as_array().expect("rows").clone()
}

#[test]
fn a_python_without_pytorch_is_refused_with_a_reason() {
    // `true` starts, but does not print what the PyTorch program prints.
    let output = run(rever().args(["bench", "decision", "--compare", "--python", "true"]));
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    let text = text(&output);
    for words in ["error: true does not run", "bench.py", "it needs torch", "--python"] {
        assert!(text.contains(words), "{text}");
    }
}

#[test]
fn a_missing_device_is_refused_with_a_reason() {
    let output = run(rever().args(["bench", "decision", "--device", "gpu"]));
    assert_eq!(output.status.code(), Some(2), "{}", text(&output));
    assert!(text(&output).contains("expected cpu, cuda or cuda:N, got gpu"), "{}", text(&output));
}
