//! Tests of the whole report on a made-up run.

use std::path::Path;

use serde_json::Value;

use super::{Report, ReportOptions, build, sample};

fn built(run: &Path, out: &Path, episodes_max: usize) -> Report {
    let options = ReportOptions { run, out, episodes_max };
    build(&options, &sample::speak, &|_, _| ()).expect("report")
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
    for record in &records {
        let id = record.identity.id();
        let entry =
            catalogue["episodes"].as_array().expect("list").iter().find(|one| one["id"] == id);
        assert_eq!(entry.expect("entry")["detail"], true);
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
    let error = build(&options, &sample::speak, &|_, _| ()).expect_err("no run");
    assert!(error.to_string().contains("is not a run"), "{error:#}");
}
