//! What `rever bench` prints and refuses; how fast anything is, no test says.

use serde_json::Value;

use crate::harness::{rever, run, succeed, text};

#[test]
fn a_benchmark_of_decisions_prints_a_table_and_writes_the_same_figures() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("bench.json");
    let mut bench = rever();
    bench.args(["bench", "decision", "--rounds", "1", "--json"]).arg(&file);
    let table = succeed(&mut bench);
    let report: Value =
        serde_json::from_slice(&std::fs::read(&file).expect("the figures")).expect("JSON");
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
fn a_python_without_pytorch_is_refused_in_words() {
    // `true` starts, and says nothing that PyTorch's side would say.
    let output = run(rever().args(["bench", "decision", "--compare", "--python", "true"]));
    assert_eq!(output.status.code(), Some(1), "{}", text(&output));
    let text = text(&output);
    for words in ["error: true does not run", "bench.py", "it needs torch", "--python"] {
        assert!(text.contains(words), "{text}");
    }
}
