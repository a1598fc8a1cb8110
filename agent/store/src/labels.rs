//! The label store: one row per recorded episode of any run. Verifiers are trained from it.
//!
//! A row names its record and contains every field that determines whether the episode may be used
//! for training: layout, seed, strategy, temperature, policy. Rows come only from records, each in
//! the transaction that adds its record to the run's index. Published outcomes are never read here.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use protocol::{EpisodeOutcome, Statistics};
use rusqlite::{Connection, OpenFlags, OptionalExtension, Row, params};

use crate::durable::check_writable;
use crate::record::EpisodeRecord;

/// Version of the schema; a store of another version is refused.
const STORE_VERSION: i64 = 2;
/// How long a writer waits for another writer.
pub(crate) const WAIT: Duration = Duration::from_secs(30);

/// An open label store. Several processes may write one store.
#[derive(Debug)]
pub struct LabelStore {
    connection: Connection,
    path: PathBuf,
}

/// One finished episode.
#[derive(Debug, Clone, PartialEq)]
pub struct Label {
    /// The episode's name within its run.
    pub id: String,
    /// The outcome of the episode.
    pub outcome: EpisodeOutcome,
    /// Path of its record; `None` if the record is on another machine.
    pub record: Option<PathBuf>,
}

impl Label {
    /// The label of a record at `path`.
    pub fn new(record: &EpisodeRecord, path: &Path) -> Label {
        let (id, path) = (record.identity.id(), path.to_path_buf());
        Label { id, outcome: outcome(record), record: Some(path) }
    }
}

/// The outcome that is published for a record.
pub fn outcome(record: &EpisodeRecord) -> EpisodeOutcome {
    let (identity, versions) = (&record.identity, &record.versions);
    EpisodeOutcome {
        run: identity.run.clone(),
        task: identity.task.clone(),
        variant: identity.variant.clone(),
        layout: identity.layout,
        seed: identity.seed,
        episode: identity.episode,
        strategy: identity.strategy.clone(),
        candidates: identity.candidates,
        temperature: identity.temperature,
        policy: versions.policy.clone(),
        verifier: versions.verifier.clone(),
        statistics: record.statistics,
        steps: record.steps.len() as u32,
        score_mean: record.score_mean(),
        simulator: versions.simulator.clone(),
    }
}

impl LabelStore {
    /// Opens the store for writing and creates it if necessary. Fails at once if labels could not
    /// be written later.
    pub fn open(path: &Path) -> Result<LabelStore> {
        let name = path.display();
        check_writable(path).with_context(|| format!("cannot open the label store {name}"))?;
        let connection = Connection::open(path)
            .with_context(|| format!("cannot open the label store {name}"))?;
        connection.busy_timeout(WAIT)?;
        // A new store has version 0.
        ensure_version(&connection, path, &[STORE_VERSION, 0])?;
        ensure_whole(&connection, path)?;
        connection
            .execute_batch(SCHEMA)
            .with_context(|| format!("cannot write the label store {name}"))?;
        Ok(LabelStore { connection, path: path.to_path_buf() })
    }

    /// Stores a label; true if the episode had none.
    pub fn insert(&self, label: &Label) -> Result<bool> {
        let write = || -> Result<bool> {
            let is_new = !contains(&self.connection, &label.outcome.run, &label.id)?;
            insert(&self.connection, label)?;
            Ok(is_new)
        };
        write().with_context(|| format!("cannot write the label store {}", self.path.display()))
    }
}

/// All labels of a store, ordered by run and name. Opens the store read-only.
pub fn labels(path: &Path) -> Result<Vec<Label>> {
    let name = path.display();
    ensure!(
        path.is_file(),
        "label store {name} does not exist; run `rever collect` first, or name runs or --labels"
    );
    let connection = Connection::open_with_flags(path, OpenFlags::SQLITE_OPEN_READ_ONLY)
        .with_context(|| format!("cannot open the label store {name}"))?;
    connection.busy_timeout(WAIT)?;
    ensure_version(&connection, path, &[STORE_VERSION])?;
    ensure_whole(&connection, path)?;
    let mut statement = connection.prepare("SELECT * FROM labels ORDER BY run, id")?;
    let labels = statement.query_map([], read)?;
    labels.map(|label| label.with_context(|| format!("label store {name}: damaged row"))).collect()
}

fn ensure_version(connection: &Connection, path: &Path, expected: &[i64]) -> Result<()> {
    let name = path.display();
    let version: i64 = connection
        .query_row("PRAGMA user_version", [], |row| row.get(0))
        .with_context(|| format!("{name} is not a label store"))?;
    ensure!(
        expected.contains(&version),
        "label store {name}: expected version {STORE_VERSION}, got {version}; choose another file"
    );
    Ok(())
}

/// Labels can be restored, but only by rerunning the commands of their runs.
fn ensure_whole(connection: &Connection, path: &Path) -> Result<()> {
    let found: rusqlite::Result<String> =
        connection.query_row("PRAGMA quick_check(1)", [], |row| row.get(0));
    let found = found.unwrap_or_else(|error| error.to_string());
    ensure!(
        found == "ok",
        "label store {}: damaged: {found}; move the file away and rerun the commands that wrote its labels",
        path.display()
    );
    Ok(())
}

/// Writes a label to the open or attached store, replacing an earlier one.
pub(crate) fn insert(connection: &Connection, label: &Label) -> rusqlite::Result<()> {
    let (outcome, statistics) = (&label.outcome, &label.outcome.statistics);
    let record = label.record.as_ref().map(|path| path.to_string_lossy().into_owned());
    connection.prepare_cached(INSERT)?.execute(params![
        outcome.run,
        label.id,
        outcome.task,
        outcome.variant,
        outcome.layout,
        outcome.seed as i64,
        outcome.episode,
        outcome.strategy,
        outcome.candidates,
        outcome.temperature,
        outcome.policy,
        outcome.verifier,
        statistics.is_success,
        statistics.is_grasped,
        statistics.ever_grasped,
        statistics.consecutive_grasp,
        statistics.moved_correct_object,
        statistics.moved_wrong_object,
        statistics.source_on_target,
        statistics.ever_success,
        statistics.released_success,
        outcome.steps,
        outcome.score_mean,
        outcome.simulator,
        record
    ])?;
    Ok(())
}

/// The changes that reconciling made for one run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Corrections {
    /// Number of labels that differed from their records.
    pub changed: usize,
    /// Number of labels without a record.
    pub removed: usize,
}

/// Makes the labels of `run` in the attached store equal to its records, which are in `folder`.
pub(crate) fn reconcile(
    connection: &Connection,
    run: &str,
    folder: &Path,
    expected: &[Label],
) -> Result<Corrections> {
    let mut statement = connection.prepare("SELECT id FROM labels WHERE run = ?1")?;
    let ids = statement.query_map([run], |row| row.get(0))?;
    let ids = ids.collect::<rusqlite::Result<Vec<String>>>()?;
    let mut one = connection.prepare("SELECT * FROM labels WHERE run = ?1 AND id = ?2")?;
    let mut found = BTreeMap::new();
    for id in ids {
        // A row that cannot be read is wrong in any case.
        let label = one.query_row([run, &id], read).ok();
        found.insert(id, label);
    }
    let mut corrections = Corrections::default();
    for label in expected {
        match found.remove(&label.id) {
            Some(Some(same)) if same == *label => continue,
            // The run's folder was moved.
            Some(Some(other)) if other.outcome == label.outcome => {}
            Some(_) => corrections.changed += 1,
            None => {}
        }
        insert(connection, label)?;
    }
    for (id, label) in found {
        let record = label.and_then(|label| label.record);
        // A copy of the run in another folder may have been resumed independently.
        if record.is_none_or(|record| record.starts_with(folder)) {
            connection.execute("DELETE FROM labels WHERE run = ?1 AND id = ?2", [run, &id])?;
            corrections.removed += 1;
        }
    }
    Ok(corrections)
}

fn contains(connection: &Connection, run: &str, id: &str) -> rusqlite::Result<bool> {
    let mut statement =
        connection.prepare_cached("SELECT 1 FROM labels WHERE run = ?1 AND id = ?2")?;
    Ok(statement.query_row([run, id], |_| Ok(())).optional()?.is_some())
}

const INSERT: &str = "INSERT OR REPLACE INTO labels VALUES
    (?1,?2,?3,?4,?5,?6,?7,?8,?9,?10,?11,?12,?13,?14,?15,?16,?17,?18,?19,?20,?21,?22,?23,?24,?25)";

/// Uses a rollback journal: a write-ahead log works on one host only and has no transactions over
/// two files.
const SCHEMA: &str = "
    PRAGMA journal_mode = DELETE;
    BEGIN IMMEDIATE;
    CREATE TABLE IF NOT EXISTS labels (
        run TEXT NOT NULL, id TEXT NOT NULL, task TEXT NOT NULL, variant TEXT NOT NULL, layout INTEGER,
        seed INTEGER NOT NULL, episode INTEGER NOT NULL, strategy TEXT NOT NULL, candidates INTEGER NOT NULL,
        temperature REAL NOT NULL, policy TEXT NOT NULL, verifier TEXT,
        is_success INTEGER NOT NULL, is_grasped INTEGER NOT NULL, ever_grasped INTEGER NOT NULL,
        consecutive_grasp INTEGER NOT NULL, moved_correct_object INTEGER NOT NULL, moved_wrong_object INTEGER NOT NULL,
        source_on_target INTEGER NOT NULL, ever_success INTEGER NOT NULL, released_success INTEGER NOT NULL,
        steps INTEGER NOT NULL, score_mean REAL, simulator TEXT NOT NULL, record TEXT,
        PRIMARY KEY (run, id));
    PRAGMA user_version = 2;
    COMMIT;";

fn read(row: &Row<'_>) -> rusqlite::Result<Label> {
    let outcome = EpisodeOutcome {
        run: row.get("run")?,
        task: row.get("task")?,
        variant: row.get("variant")?,
        layout: row.get("layout")?,
        seed: row.get::<_, i64>("seed")? as u64,
        episode: row.get("episode")?,
        strategy: row.get("strategy")?,
        candidates: row.get("candidates")?,
        temperature: row.get("temperature")?,
        policy: row.get("policy")?,
        verifier: row.get("verifier")?,
        statistics: Statistics {
            is_success: row.get("is_success")?,
            is_grasped: row.get("is_grasped")?,
            ever_grasped: row.get("ever_grasped")?,
            consecutive_grasp: row.get("consecutive_grasp")?,
            moved_correct_object: row.get("moved_correct_object")?,
            moved_wrong_object: row.get("moved_wrong_object")?,
            source_on_target: row.get("source_on_target")?,
            ever_success: row.get("ever_success")?,
            released_success: row.get("released_success")?,
        },
        steps: row.get("steps")?,
        score_mean: row.get("score_mean")?,
        simulator: row.get("simulator")?,
    };
    let record: Option<String> = row.get("record")?;
    Ok(Label { id: row.get("id")?, outcome, record: record.map(PathBuf::from) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::tests::made_up;

    fn label(episode: u32) -> Label {
        Label::new(&made_up(episode), Path::new("/runs/a/episodes/x.msgpack"))
    }

    #[test]
    fn a_label_is_read_back_unchanged_and_an_episode_has_one_row() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("deep/labels.sqlite");
        let store = LabelStore::open(&path).expect("a store");
        let wrong = Label { outcome: EpisodeOutcome { steps: 99, ..label(3).outcome }, ..label(3) };
        assert!(store.insert(&wrong).expect("first"));
        assert!(!store.insert(&label(3)).expect("second"));
        let journal = |row: &Row<'_>| row.get::<_, String>(0);
        let mode = store.connection.query_row("PRAGMA journal_mode", [], journal);
        assert_eq!(mode.expect("a mode"), "delete", "a write-ahead log works on one host only");
        let elsewhere = Label { record: None, ..label(4) };
        assert!(store.insert(&elsewhere).expect("another"));
        assert_eq!(labels(&path).expect("labels"), [label(3), elsewhere]);
    }

    #[test]
    fn labels_are_made_equal_to_the_records_of_a_run() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("labels.sqlite");
        let store = LabelStore::open(&path).expect("a store");
        // A forged label, one without a record, one of another run, one of a copy of the run, and
        // one with a moved record.
        let mut forged = label(0);
        forged.outcome.statistics.is_success = false;
        let mut other_run = label(0);
        other_run.outcome.run = "other".into();
        let copy = Label { record: Some("/runs/copy/episodes/x.msgpack".into()), ..label(8) };
        let moved = Label { record: Some("/runs/before/episodes/x.msgpack".into()), ..label(1) };
        for label in [&forged, &label(7), &other_run, &copy, &moved] {
            assert!(store.insert(label).expect("a row"));
        }
        let run = Path::new("/runs/a");
        let expected = [label(0), label(1), label(2)];
        let corrections = reconcile(&store.connection, "made-up", run, &expected).expect("written");
        assert_eq!(corrections, Corrections { changed: 1, removed: 1 });
        let [first, second, third] = expected.clone();
        assert_eq!(labels(&path).expect("labels"), [first, second, third, copy, other_run]);
        let again = reconcile(&store.connection, "made-up", run, &expected).expect("written");
        assert_eq!(again, Corrections::default());
    }

    #[test]
    fn a_file_that_is_not_a_label_store_is_refused_by_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("labels.sqlite");
        let check = |path: &Path, expected: &str| {
            let writing = format!("{:#}", LabelStore::open(path).expect_err(expected));
            let reading = format!("{:#}", labels(path).expect_err(expected));
            for error in [writing, reading] {
                assert!(error.contains(expected), "{error}");
                assert!(error.contains(&path.display().to_string()), "{error}");
            }
        };
        let other = Connection::open(&path).expect("a database");
        other.execute_batch("PRAGMA user_version = 1").expect("a version");
        check(&path, "expected version 2, got 1");
        let text = folder.path().join("text");
        std::fs::write(&text, "no database at all, but long enough for a header of one".repeat(9))
            .expect("a file");
        check(&text, "is not a label store");
        let missing = folder.path().join("none.sqlite");
        let error = labels(&missing).expect_err("none").to_string();
        assert!(
            error.ends_with(
                "none.sqlite does not exist; run `rever collect` first, or name runs or --labels"
            ),
            "{error}"
        );
        assert!(!missing.exists(), "reading makes none");
    }

    #[test]
    fn a_damaged_store_is_reported_before_anything_is_written() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("labels.sqlite");
        let store = LabelStore::open(&path).expect("a store");
        for episode in 0..200 {
            store.insert(&label(episode)).expect("a row");
        }
        drop(store);
        let mut bytes = std::fs::read(&path).expect("a file");
        bytes[20_000..40_000].iter_mut().for_each(|byte| *byte = !*byte);
        std::fs::write(&path, &bytes).expect("damaged");
        for error in [LabelStore::open(&path).map(drop), labels(&path).map(drop)] {
            let error = error.expect_err("damaged").to_string();
            assert!(error.contains("labels.sqlite: damaged"), "{error}");
        }
        assert_eq!(std::fs::read(&path).expect("a file"), bytes);
    }
}
