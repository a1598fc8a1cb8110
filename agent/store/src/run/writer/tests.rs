//! Tests of the writer: a run survives killed processes and damaged files.

use std::os::unix::fs::PermissionsExt;

use serde_json::json;
use sha2::{Digest, Sha256};

use super::*;
use crate::labels::{Label, labels};
use crate::queue::FaultScope;
use crate::record::{RecordFile, tests::made_up};
use crate::run::records::VIDEOS;
use crate::run::{faults::FAULTS, index::INDEX, recorded, summaries, video_path, write_video};

fn request(folder: &Path) -> RunRequest {
    RunRequest {
        folder: folder.join("run"),
        labels: Some(folder.join("labels.sqlite")),
        options: json!({"seed": 1, "settings": ["greedy"]}),
        versions: json!({"policy": "cafe"}),
        served: None,
        command: vec!["rever".into(), "evaluate".into()],
        build: Build { commit: "f00d".into(), ..Build::default() },
    }
}

fn open(folder: &Path) -> Run {
    Run::open(&request(folder)).expect("a run")
}

fn episode(run: &Run, episode: u32) -> EpisodeRecord {
    let mut record = made_up(episode);
    record.identity.run.clone_from(&run.header.run);
    record
}

fn record(run: &Run, number: u32) -> PathBuf {
    let record = episode(run, number);
    run.record(&record).expect("recorded");
    record_path(&run.folder, &record.identity.id())
}

fn episodes(summaries: &[EpisodeSummary]) -> Vec<u32> {
    summaries.iter().map(|summary| summary.identity.episode).collect()
}

fn stored(folder: &Path) -> Vec<Label> {
    labels(&folder.join("labels.sqlite")).expect("labels")
}

/// Overwrites a row of any database, like damage or a forgery.
fn tamper(path: &Path, sql: &str) {
    let connection = Connection::open(path).expect("a database");
    assert!(connection.execute(sql, []).expect("tampered") > 0);
}

#[test]
fn a_run_is_resumed_with_its_records_and_every_record_has_its_provenance() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    let path = record(&run, 0);
    let name = run.header.run.clone();
    drop(run);
    let run = open(folder.path());
    assert_eq!(run.header.run, name);
    record(&run, 1);
    assert_eq!(episodes(&run.summaries().expect("summaries")), [0, 1]);
    assert_eq!(episodes(&summaries(&run.folder).expect("while it is written")), [0, 1]);
    assert_eq!(recorded(&run.folder).expect("names").len(), 2);
    let provenance = RecordFile::read(&path).expect("a record").provenance;
    let RunRequest { command, options, build, .. } = request(folder.path());
    assert_eq!(provenance, Provenance { command, options, build });
    assert_eq!(run.header.starts.len(), 1, "twice the same command and build");
}

#[test]
fn two_processes_cannot_write_one_run() {
    let folder = tempfile::tempdir().expect("a folder");
    let _first = open(folder.path());
    let error = Run::open(&request(folder.path())).expect_err("locked");
    assert!(error.to_string().ends_with("is being written by another process"), "{error}");
}

#[test]
fn a_closed_run_is_free_while_a_starting_child_still_holds_its_files() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    let _held_by_the_child = run._lock.0.try_clone().expect("a copy");
    drop(run);
    open(folder.path());
}

#[test]
fn index_and_label_store_get_an_episode_together_or_not_at_all() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    let path = record(&run, 0);
    assert_eq!(stored(folder.path()), [Label::new(&episode(&run, 0), &path)]);
    // While another process locks the label store, neither index nor store gets the episode.
    let other = Connection::open(folder.path().join("labels.sqlite")).expect("a store");
    other.execute_batch("BEGIN EXCLUSIVE").expect("locked");
    run.connection.busy_timeout(std::time::Duration::ZERO).expect("no wait");
    record(&run, 1);
    assert_eq!(index::summaries(&run.connection).expect("an index").len(), 1);
    assert_eq!(episodes(&summaries(&run.folder).expect("from its record")), [0, 1]);
    other.execute_batch("COMMIT").expect("unlocked");
    assert_eq!(stored(folder.path()).len(), 1);
    record(&run, 2);
    run.complete().expect("completed");
    assert_eq!(stored(folder.path()).len(), 3);
    assert_eq!(index::summaries(&run.connection).expect("an index").len(), 3);
}

#[test]
fn an_episode_in_which_the_policy_never_acted_is_recorded_without_a_label() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    let mut record = episode(&run, 0);
    for decision in record.steps.iter_mut().filter_map(|step| step.decision.as_mut()) {
        decision.chosen = None;
    }
    run.record(&record).expect("recorded");
    assert_eq!(episodes(&run.summaries().expect("summaries")), [0]);
    drop(run);
    drop(open(folder.path()));
    assert_eq!(stored(folder.path()), []);
}

#[test]
fn labels_that_could_not_be_written_are_reported_and_written_when_the_run_is_resumed() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    let other = Connection::open(folder.path().join("labels.sqlite")).expect("a store");
    other.execute_batch("BEGIN EXCLUSIVE").expect("locked");
    run.connection.busy_timeout(std::time::Duration::ZERO).expect("no wait");
    record(&run, 0);
    let error = format!("{:#}", run.complete().expect_err("one label is missing"));
    assert!(error.starts_with("1 recorded episodes of the run run-"), "{error}");
    assert!(error.contains("to write them: cannot write the index of"), "{error}");
    assert!(error.contains("labels.sqlite: database is locked"), "{error}");
    other.execute_batch("COMMIT").expect("unlocked");
    assert_eq!(stored(folder.path()), []);
    drop(run);
    drop(open(folder.path()));
    assert_eq!(stored(folder.path()).len(), 1);
}

#[test]
fn labels_are_restored_from_the_records() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    for number in 0..3 {
        record(&run, number);
    }
    let expected = stored(folder.path());
    drop(run);
    let store = folder.path().join("labels.sqlite");
    tamper(&store, "UPDATE labels SET is_success = NOT is_success, steps = 99 WHERE episode = 1");
    tamper(&store, "DELETE FROM labels WHERE episode = 2");
    tamper(
        &store,
        "INSERT INTO labels SELECT run, '../../forged', task, variant, layout, seed, 77, strategy, candidates,
         temperature, policy, verifier, 1, 1, 1, 1, 1, 1, 1, 1, 1, 60, 0.5, 'forged', NULL FROM labels LIMIT 1",
    );
    drop(open(folder.path()));
    assert_eq!(stored(folder.path()), expected);
}

#[test]
fn a_moved_run_has_labels_that_name_its_records() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    record(&run, 0);
    let before = run.folder.clone();
    drop(run);
    let request = RunRequest { folder: folder.path().join("moved"), ..request(folder.path()) };
    std::fs::rename(before, &request.folder).expect("moved");
    drop(Run::open(&request).expect("the same run"));
    let labels = stored(folder.path());
    assert_eq!(labels.len(), 1);
    let path = labels[0].record.as_ref().expect("a record");
    assert!(path.starts_with(&request.folder) && path.exists(), "{}", path.display());
}

#[test]
fn a_reader_does_not_change_the_index_of_a_running_writer() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    for number in 0..3 {
        record(&run, number);
    }
    let index = run.folder.join(INDEX);
    let expected = run.summaries().expect("summaries");
    // An index of another build, a row that was modified, and a row whose summary lacks a field.
    let check = |change: &dyn Fn(&Connection)| {
        let other = Connection::open(&index).expect("an index");
        change(&other);
        drop(other);
        let before = std::fs::read(&index).expect("an index");
        assert!(index::read(&run.folder).is_err(), "it is not used");
        assert_eq!(summaries(&run.folder).expect("from the records"), expected);
        assert_eq!(std::fs::read(&index).expect("an index"), before);
    };
    let whole = std::fs::read(&index).expect("an index");
    check(&|index| index.execute_batch("PRAGMA user_version = 99").expect("changed"));
    std::fs::write(&index, &whole).expect("as it was");
    check(&|index| {
        let sql = "UPDATE episodes SET summary = replace(summary, 'true', 'false')";
        assert_eq!(index.execute(sql, []).expect("changed"), 3);
    });
    std::fs::write(&index, &whole).expect("as it was");
    check(&|index| {
        let text = r#"{"steps": 60}"#;
        let sha256 = crate::digest::hex(&Sha256::digest(text));
        let sql = "UPDATE episodes SET summary = ?1, sha256 = ?2";
        assert_eq!(index.execute(sql, [text, &sha256]).expect("changed"), 3);
    });
    std::fs::write(record_path(&run.folder, &expected[1].identity.id()), b"half").expect("damaged");
    assert_eq!(episodes(&summaries(&run.folder).expect("the others")), [0, 2]);
    // The writer continues.
    record(&run, 3);
    assert_eq!(stored(folder.path()).len(), 4);
    run.complete().expect("nothing is missing");
}

#[test]
fn a_reader_needs_no_permission_to_write() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    record(&run, 0);
    let path = run.folder.clone();
    drop(run);
    let set = |mode: u32| {
        for (path, mode) in [(path.join(INDEX), mode & 0o666), (path.clone(), mode)] {
            std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).expect("a mode");
        }
    };
    set(0o555);
    let (read, index) = (summaries(&path), index::read(&path));
    set(0o755);
    assert_eq!(episodes(&read.expect("readable")), [0]);
    assert_eq!(index.expect("a usable index").len(), 1);
    assert!(!path.join(format!("{INDEX}-journal")).exists());
}

#[test]
fn the_index_is_always_recreated() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    for number in 0..50 {
        record(&run, number);
    }
    let index = run.folder.join(INDEX);
    let expected = run.summaries().expect("summaries");
    drop(run);
    let whole = std::fs::read(&index).expect("an index");
    let damaged: Vec<u8> = (0..whole.len())
        .map(|place| if (12_000..24_000).contains(&place) { !whole[place] } else { whole[place] })
        .collect();
    let check = |bytes: Option<&[u8]>| {
        match bytes {
            Some(bytes) => std::fs::write(&index, bytes).expect("written"),
            None => std::fs::remove_file(&index).expect("removed"),
        }
        let path = index.parent().expect("a folder");
        assert_eq!(summaries(path).expect("a reader"), expected);
        let run = open(folder.path());
        assert_eq!(run.summaries().expect("the writer"), expected);
        assert_eq!(index::summaries(&run.connection).expect("the index").len(), 50);
        drop(run);
    };
    check(None);
    check(Some(&[0x5a; 4096]));
    check(Some(&whole[..whole.len() / 2]));
    check(Some(&damaged));
    std::fs::remove_file(record_path(
        index.parent().expect("a folder"),
        &expected[2].identity.id(),
    ))
    .expect("a record");
    let run = open(folder.path());
    assert_eq!(run.summaries().expect("summaries").len(), 49);
    drop(run);
    assert_eq!(stored(folder.path()).len(), 49);
}

#[test]
fn a_damaged_record_is_set_aside_and_its_episode_is_run_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    let paths: Vec<PathBuf> = (0..5).map(|number| record(&run, number)).collect();
    let (path, expected) = (run.folder.clone(), run.summaries().expect("summaries"));
    drop(run);
    // A flipped bit, a truncated file, an empty file, and the record of another episode.
    let mut bytes = std::fs::read(&paths[0]).expect("a record");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&paths[0], &bytes).expect("damaged");
    std::fs::write(&paths[1], &bytes[..middle]).expect("damaged");
    std::fs::write(&paths[2], b"").expect("damaged");
    std::fs::copy(&paths[4], &paths[3]).expect("damaged");
    let run = open(folder.path());
    assert_eq!(episodes(&run.summaries().expect("summaries")), [4]);
    assert_eq!(recorded(&run.folder).expect("names").len(), 1);
    assert_eq!(stored(folder.path()).len(), 1, "no label of a record that is gone");
    for aside in &paths[..4] {
        let aside = PathBuf::from(format!("{}.damaged", aside.display()));
        assert!(aside.exists(), "{}", aside.display());
    }
    for number in 0..4 {
        record(&run, number);
    }
    drop(run);
    assert_eq!(summaries(&path).expect("summaries"), expected);
    assert_eq!(
        recorded(&open(folder.path()).folder).expect("names").len(),
        5,
        "what is aside stays there"
    );
}

#[test]
fn records_of_another_version_are_never_set_aside() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    let path = record(&run, 0);
    drop(run);
    let old = json!({"version": 3, "steps": []});
    std::fs::write(&path, rmp_serde::to_vec_named(&old).expect("bytes")).expect("written");
    let error = Run::open(&request(folder.path())).expect_err("another version").to_string();
    assert!(error.contains("expected record version 4, got 3; choose another folder"), "{error}");
    assert!(path.exists());
}

#[test]
fn a_record_of_another_run_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    let error = run.record(&made_up(0)).expect_err("another run").to_string();
    assert!(error.contains("expected a record of the run run-"), "{error}");
    assert!(error.ends_with("got made-up"), "{error}");
    assert!(recorded(&run.folder).expect("names").is_empty());
}

#[test]
fn a_label_store_that_cannot_be_written_is_reported_before_anything_starts() {
    let folder = tempfile::tempdir().expect("a folder");
    let check = |labels: &Path, expected: &str| {
        let request = RunRequest { labels: Some(labels.to_path_buf()), ..request(folder.path()) };
        let error = format!("{:#}", Run::open(&request).expect_err(expected));
        assert!(
            error.contains(expected) && error.contains(&labels.display().to_string()),
            "{error}"
        );
    };
    check(folder.path(), "it exists and is not a file");
    check(Path::new("/proc/labels.sqlite"), "cannot open the label store");
    let text = folder.path().join("text");
    std::fs::write(&text, "a text ".repeat(100)).expect("a file");
    check(&text, "is not a label store");
}

#[test]
fn incomplete_files_of_a_killed_process_are_ignored() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = open(folder.path());
    let fault = FaultRecord {
        identity: made_up(0).identity,
        attempt: 1,
        server: "s".into(),
        scope: FaultScope::Server,
        reason: "lost".into(),
    };
    run.fault(&fault).expect("noted");
    let path = run.folder.clone();
    write_video(&path, "a", b"a film").expect("written");
    drop(run);
    let unfinished = ["", EPISODES, VIDEOS].map(|folder| path.join(folder).join(".tmpabc"));
    for half in &unfinished {
        std::fs::write(half, b"half").expect("written");
    }
    let append = |bytes: &[u8]| {
        let mut text = std::fs::read(path.join(FAULTS)).expect("faults");
        text.extend(bytes);
        std::fs::write(path.join(FAULTS), text).expect("written");
    };
    append(b"{\"identity\": {");
    let run = open(folder.path());
    assert!(!unfinished.iter().any(|half| half.exists()));
    assert_eq!(std::fs::read(video_path(&path, "a")).expect("a video"), b"a film");
    assert_eq!(faults::faults(&path).expect("faults"), std::slice::from_ref(&fault));
    run.fault(&fault).expect("noted");
    drop(run);
    // Lines that are not text or not a fault are ignored; those around them are counted.
    append(b"\xff\xfe\n{\"attempt\": 1}\n");
    let run = open(folder.path());
    run.fault(&fault).expect("noted");
    assert_eq!(faults::faults(&path).expect("faults"), [fault.clone(), fault.clone(), fault]);
    assert_eq!(recorded(&path).expect("names").len(), 0);
}
