//! Tests of the whole report on a made-up run.

use std::path::Path;

use serde_json::Value;

use super::{Readers, Report, ReportOptions, build, chosen_scores, details::Details, sample};

fn built(run: &Path, out: &Path, episodes_max: usize) -> Report {
    let options = ReportOptions { run, out, episodes_max };
    build(&options, &sample::readers(), &|_, _| ()).expect("report")
}

/// The value that a data file hands over.
fn value_of(file: &Path, before: &str, after: &str) -> Value {
    let text = std::fs::read_to_string(file).expect("data file");
    let json = text.strip_prefix(before).and_then(|text| text.strip_suffix(after));
    serde_json::from_str(json.expect("one expression")).expect("JSON")
}

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).expect("folder");
    entries.map(|entry| entry.expect("entry").file_name().into_string().expect("name")).collect()
}

#[test]
fn every_episode_of_the_run_is_in_the_report() {
    let folder = tempfile::tempdir().expect("folder");
    let (run, out) = (folder.path().join("run"), folder.path().join("report"));
    sample::write(&run).expect("run");
    let report = built(&run, &out, 1000);
    let records = sample::records();
    assert_eq!((report.episodes, report.detailed), (records.len(), records.len()));
    let videos = records.iter().filter(|record| sample::has_video(record)).count();
    assert_eq!((report.videos, names(&out.join("videos")).len()), (videos, videos));
    let catalogue = value_of(&out.join("data/catalogue.js"), "window.reverCatalogue = ", ";\n");
    let pairs = catalogue["pairs"].as_array().expect("pairs");
    let listed = || pairs.iter().flat_map(|pair| pair["episodes"].as_array().expect("episodes"));
    for record in &records {
        let id = record.identity.id();
        let entry = listed().find(|one| one["id"] == id).expect("entry");
        assert_eq!(entry["detail"], true);
        let first = record.steps.iter().position(|step| step.statistics.is_success);
        assert_eq!(entry["success"], first.map_or(Value::Null, Value::from));
        let details = value_of(&out.join(format!("data/{id}.js")), "reverEpisode(", ");\n");
        let steps = details["steps"].as_array().expect("steps");
        assert_eq!(steps.len(), record.steps.len());
        for (step, recorded) in steps.iter().zip(&record.steps) {
            let decision = recorded.decision.as_ref().expect("a decision");
            assert_eq!(step["chosen"], decision.chosen.map_or(Value::Null, Value::from));
            assert_eq!(
                step["candidates"].as_array().expect("list").len(),
                decision.candidates.len()
            );
            assert_eq!(
                step["flags"].as_u64().expect("bits") & 1 == 1,
                recorded.statistics.is_grasped
            );
        }
    }
}

#[test]
fn candidates_keep_their_words_and_malformed_ones_their_reason() {
    let folder = tempfile::tempdir().expect("folder");
    let (run, out) = (folder.path().join("run"), folder.path().join("report"));
    sample::write(&run).expect("run");
    built(&run, &out, 1000);
    let record = sample::records().pop().expect("record");
    let file = out.join(format!("data/{}.js", record.identity.id()));
    let details = value_of(&file, "reverEpisode(", ");\n");
    let phrase =
        |number: &Value| details["phrases"][number.as_u64().expect("number") as usize].clone();
    let mut malformed = 0;
    for (step, recorded) in record.steps.iter().enumerate() {
        for (index, candidate) in
            recorded.decision.iter().flat_map(|one| &one.candidates).enumerate()
        {
            let shown = &details["steps"][step]["candidates"][index];
            let speech = sample::speak(&candidate.tokens);
            match speech.reasoning {
                Some(reasoning) => {
                    assert_eq!(phrase(&shown["says"][3]), reasoning.subtask);
                    assert_eq!(phrase(&shown["says"][5]), reasoning.movement);
                    assert_eq!(shown["boxes"][1][1], reasoning.visible_objects[1].bounding_box[0]);
                }
                None => {
                    assert_eq!(phrase(&shown["text"]), speech.text);
                    assert_eq!(phrase(&shown["malformed"]), "expected 7 action tokens, got </s>");
                    malformed += 1;
                }
            }
        }
    }
    assert!(malformed > 0, "the made-up run has malformed candidates");
}

#[test]
fn nothing_that_a_model_wrote_is_markup_anywhere() {
    let folder = tempfile::tempdir().expect("folder");
    let (run, out) = (folder.path().join("run"), folder.path().join("report"));
    sample::write(&run).expect("run");
    built(&run, &out, 1000);
    for name in names(&out.join("data")) {
        let text = std::fs::read_to_string(out.join("data").join(&name)).expect("data");
        assert!(!text.contains('<'), "{name} holds markup");
    }
    let page = std::fs::read_to_string(out.join("index.html")).expect("page");
    for outside in ["http:", "https:", "//cdn", "@import"] {
        assert!(!page.contains(outside), "the page refers to {outside}");
    }
}

#[test]
fn a_second_report_replaces_the_first_and_respects_its_limit() {
    let folder = tempfile::tempdir().expect("folder");
    let (run, out) = (folder.path().join("run"), folder.path().join("report"));
    sample::write(&run).expect("run");
    built(&run, &out, 1000);
    let report = built(&run, &out, 4);
    assert_eq!(report.detailed, 4);
    // Four episodes and the catalogue.
    assert_eq!(names(&out.join("data")).len(), 5);
    let page = std::fs::read(out.join("index.html")).expect("page");
    built(&run, &out, 4);
    assert_eq!(std::fs::read(out.join("index.html")).expect("page"), page);
}

#[test]
fn a_run_without_episodes_is_refused_in_words() {
    let folder = tempfile::tempdir().expect("folder");
    let run = folder.path().join("run");
    let options = ReportOptions { run: &run, out: folder.path(), episodes_max: 1 };
    let error = build(&options, &sample::readers(), &|_, _| ()).expect_err("no run");
    assert!(error.to_string().contains("is not a run"), "{error:#}");
}

#[test]
fn a_score_is_selected_only_where_the_strategy_looked_at_the_candidates() {
    let record = sample::records().into_iter().find(|one| one.identity.candidates == 5);
    let mut record = record.expect("a record with five candidates");
    for (strategy, expected) in
        [("verifier", true), ("sample", false), ("first-well-formed", false)]
    {
        record.identity.strategy = strategy.into();
        let scored = chosen_scores(&record).expect("scores");
        assert!(!scored.is_empty());
        assert!(scored.iter().all(|one| one.is_selected == expected), "{strategy} of five");
    }
}

#[test]
fn chunks_and_policies_without_text_are_shown_as_they_are() {
    let mut record = sample::records().remove(0);
    record.steps.truncate(2);
    let chunk = vec![vec![0.5, -0.25], vec![0.125, 1.0]];
    let candidates = &mut record.steps[0].decision.as_mut().expect("a decision").candidates;
    candidates[0].tokens.clear();
    candidates[0].actions = Some(chunk.clone().try_into().expect("a chunk"));
    candidates[0].malformed = None;
    record.steps[1].decision = None;
    let readers =
        Readers { speak: &|_| panic!("there are no tokens to read"), ..sample::readers() };
    let details = Details::new(&record, &readers).expect("details");
    let shown = serde_json::to_value(&details).expect("JSON");
    assert_eq!(shown["steps"][0]["candidates"][0]["actions"], serde_json::json!(chunk));
    assert_eq!(shown["steps"][1]["decision_ms"], Value::Null);
    assert_eq!(shown["steps"][1]["candidates"], serde_json::json!([]));
}

#[test]
fn the_page_tells_malformed_candidates_and_held_steps_of_every_setting() {
    let folder = tempfile::tempdir().expect("folder");
    let (run, out) = (folder.path().join("run"), folder.path().join("report"));
    sample::write(&run).expect("run");
    built(&run, &out, 1);
    let page = std::fs::read_to_string(out.join("index.html")).expect("page");
    let malformed: usize = sample::summaries().iter().map(|one| one.malformed as usize).sum();
    assert!(
        page.contains(&format!("malformed candidates</abbr></dt><dd>{malformed}</dd>")),
        "{page}"
    );
    for setting in ["greedy", "sample T=1", "verifier N=5 T=1"] {
        let rows = page.matches(&format!("scope=\"row\">{setting}</th>")).count();
        assert_eq!(rows, 2, "rates and counts of {setting}");
    }
    assert!(page.contains("21.5 ms in batches of 4"), "a decision's own time");
}

#[test]
fn candidates_have_the_largest_terms_of_their_score_or_the_reason_why_not() {
    let readers = sample::readers();
    let records = sample::records();
    let find = |candidates| records.iter().find(|one| one.identity.candidates == candidates);
    let details = |candidates| {
        let details = Details::new(find(candidates).expect("a record"), &readers);
        serde_json::to_value(details.expect("details")).expect("JSON")
    };
    let single = details(1);
    assert_eq!(single["no_terms"], "one candidate has no siblings");
    let chosen = details(5);
    let step = &chosen["steps"][0]["candidates"];
    let terms: Vec<&Value> = step
        .as_array()
        .expect("candidates")
        .iter()
        .filter(|one| one["malformed"].is_null())
        .map(|one| &one["terms"])
        .collect();
    assert_eq!(*terms[0], serde_json::json!([[[1, -0.2]], 0.0]), "terms of 0 are not listed");
    assert_eq!(*terms[2], serde_json::json!([[[0, 2.0], [1, -0.2]], 0.0]));
}

#[test]
fn a_page_without_scripts_says_so_and_keeps_its_tables_and_figures() {
    let folder = tempfile::tempdir().expect("folder");
    let (run, out) = (folder.path().join("run"), folder.path().join("report"));
    sample::write(&run).expect("run");
    built(&run, &out, 1);
    let page = std::fs::read_to_string(out.join("index.html")).expect("page");
    assert!(page.contains("<noscript>") && page.contains("id=\"viewer\" hidden"));
    for part in ["role=\"table\"", "data-name=\"paired-gains\"", "class=\"glossary\""] {
        assert!(page.contains(part), "{part}");
    }
    assert!(!page.contains(" style="), "the page's policy forbids styles in attributes");
}
