//! The label store: one row per finished episode of any run, fed by the outcomes that agents publish.
//!
//! A row names the record that it comes of and everything that decides whether it may teach: layout, seed, strategy,
//! temperature, policy. The same outcome may come any number of times; it is one row.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use protocol::{EpisodeOutcome, Statistics};
use rusqlite::{Connection, OptionalExtension, Row, params};

use crate::record::{EpisodeIdentity, EpisodeRecord};

/// Version of the table; a store of another version is refused.
const STORE_VERSION: i64 = 1;
/// How long a writer waits for another one.
const WAIT_SECS: u64 = 30;

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
    /// What became of it.
    pub outcome: EpisodeOutcome,
    /// Where its record lies; none when the outcome came from another machine.
    pub record: Option<PathBuf>,
}

impl Label {
    /// The label of a record at `path`.
    pub fn new(record: &EpisodeRecord, path: &Path) -> Label {
        Label {
            id: record.identity.id(),
            outcome: outcome(record),
            record: Some(path.to_path_buf()),
        }
    }

    /// The label of an outcome whose record is out of reach.
    pub fn of_outcome(outcome: EpisodeOutcome) -> Label {
        Label { id: episode_id(&outcome), outcome, record: None }
    }
}

/// What is published of a record.
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

/// The name, within its run, of the episode that an outcome is about.
pub fn episode_id(outcome: &EpisodeOutcome) -> String {
    let identity = EpisodeIdentity {
        run: outcome.run.clone(),
        task: outcome.task.clone(),
        variant: outcome.variant.clone(),
        layout: outcome.layout,
        episode: outcome.episode,
        seed: outcome.seed,
        // Not part of the name.
        sampling_seed: 0,
        strategy: outcome.strategy.clone(),
        candidates: outcome.candidates,
        temperature: outcome.temperature,
    };
    identity.id()
}

impl LabelStore {
    /// Opens the store, making it when there is none.
    pub fn open(path: &Path) -> Result<LabelStore> {
        let name = path.display();
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)
                .with_context(|| format!("cannot make the folder of the label store {name}"))?;
        }
        let connection = Connection::open(path)
            .with_context(|| format!("cannot open the label store {name}"))?;
        connection.busy_timeout(Duration::from_secs(WAIT_SECS))?;
        let version: i64 = connection
            .query_row("PRAGMA user_version", [], |row| row.get(0))
            .with_context(|| format!("{name} is not a label store"))?;
        ensure!(
            version == STORE_VERSION || version == 0,
            "label store {name}: expected version {STORE_VERSION}, got {version}"
        );
        connection
            .execute_batch(SCHEMA)
            .with_context(|| format!("cannot make the label store {name}"))?;
        Ok(LabelStore { connection, path: path.to_path_buf() })
    }

    /// Keeps a label; true when it is new. A label that comes again may add where its record lies, and nothing else.
    pub fn insert(&self, label: &Label) -> Result<bool> {
        let (outcome, statistics) = (&label.outcome, &label.outcome.statistics);
        let record = label.record.as_ref().map(|path| path.to_string_lossy().into_owned());
        let added = self.connection.execute(
            "INSERT INTO labels VALUES (?1,?2,?3,?4,?5,?6,?7,?8,?9,?10,?11,?12,?13,?14,?15,?16,?17,?18,?19,?20,?21,?22,?23,?24,?25)
             ON CONFLICT (run, id) DO NOTHING",
            params![
                outcome.run, label.id, outcome.task, outcome.variant, outcome.layout, outcome.seed as i64,
                outcome.episode, outcome.strategy, outcome.candidates, outcome.temperature, outcome.policy,
                outcome.verifier, statistics.is_success, statistics.is_grasped, statistics.ever_grasped,
                statistics.consecutive_grasp, statistics.moved_correct_object, statistics.moved_wrong_object,
                statistics.source_on_target, statistics.ever_success, statistics.released_success, outcome.steps,
                outcome.score_mean, outcome.simulator, record
            ],
        );
        let added = added
            .with_context(|| format!("cannot write the label store {}", self.path.display()))?
            == 1;
        if !added && record.is_some() {
            self.connection.execute(
                "UPDATE labels SET record = ?3 WHERE run = ?1 AND id = ?2 AND record IS NULL",
                params![outcome.run, label.id, record],
            )?;
        }
        Ok(added)
    }

    /// Whether an episode has its label.
    pub fn contains(&self, run: &str, id: &str) -> Result<bool> {
        let mut statement =
            self.connection.prepare_cached("SELECT 1 FROM labels WHERE run = ?1 AND id = ?2")?;
        Ok(statement.query_row([run, id], |_| Ok(())).optional()?.is_some())
    }

    /// All labels, ordered by run and name.
    pub fn labels(&self) -> Result<Vec<Label>> {
        let mut statement = self.connection.prepare("SELECT * FROM labels ORDER BY run, id")?;
        let labels = statement.query_map([], read)?;
        labels.map(|label| label.context("the label store holds a row of another form")).collect()
    }
}

const SCHEMA: &str = "
    PRAGMA journal_mode = WAL;
    CREATE TABLE IF NOT EXISTS labels (
        run TEXT NOT NULL, id TEXT NOT NULL, task TEXT NOT NULL, variant TEXT NOT NULL, layout INTEGER,
        seed INTEGER NOT NULL, episode INTEGER NOT NULL, strategy TEXT NOT NULL, candidates INTEGER NOT NULL,
        temperature REAL NOT NULL, policy TEXT NOT NULL, verifier TEXT,
        is_success INTEGER NOT NULL, is_grasped INTEGER NOT NULL, ever_grasped INTEGER NOT NULL,
        consecutive_grasp INTEGER NOT NULL, moved_correct_object INTEGER NOT NULL, moved_wrong_object INTEGER NOT NULL,
        source_on_target INTEGER NOT NULL, ever_success INTEGER NOT NULL, released_success INTEGER NOT NULL,
        steps INTEGER NOT NULL, score_mean REAL, simulator TEXT NOT NULL, record TEXT,
        PRIMARY KEY (run, id));
    PRAGMA user_version = 1;";

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

    fn label(seed: u64) -> Label {
        Label::of_outcome(EpisodeOutcome {
            run: "run-1".into(),
            task: "widowx_stack_cube".into(),
            variant: "default".into(),
            layout: None,
            seed,
            episode: 3,
            strategy: "verifier+medoid".into(),
            candidates: 5,
            temperature: 0.7,
            policy: "cafe".into(),
            verifier: Some("beef".into()),
            statistics: Statistics { is_success: true, ..Statistics::default() },
            steps: 60,
            score_mean: Some(0.25),
            simulator: "mujoco 3.8.0".into(),
        })
    }

    #[test]
    fn the_same_outcome_twice_is_one_row_and_is_read_back_whole() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("deep/labels.sqlite");
        let store = LabelStore::open(&path).expect("a store");
        let mut label = label(1_000_000_007);
        assert_eq!(label.id, "widowx_stack_cube-default-0003-verifier_medoid-n5-t0.7");
        assert!(store.insert(&label).expect("first"));
        label.record = Some(PathBuf::from("runs/a/episodes/x.msgpack"));
        assert!(!store.insert(&label).expect("second"));
        assert!(store.contains("run-1", &label.id).expect("query"));
        assert!(!store.contains("run-2", &label.id).expect("query"));
        drop(store);
        assert_eq!(LabelStore::open(&path).expect("again").labels().expect("labels"), [label]);
    }

    #[test]
    fn a_store_of_another_version_and_a_file_of_another_kind_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("labels.sqlite");
        let other = Connection::open(&path).expect("a database");
        other.execute_batch("PRAGMA user_version = 7").expect("a version");
        let error = LabelStore::open(&path).expect_err("version 7");
        assert!(error.to_string().ends_with("expected version 1, got 7"), "{error}");
        let text = folder.path().join("text");
        std::fs::write(&text, "no database at all, but long enough to be read as the header of one, so that sqlite reads it all")
            .expect("a file");
        let error = LabelStore::open(&text).expect_err("text");
        assert!(error.to_string().ends_with("is not a label store"), "{error}");
    }
}
