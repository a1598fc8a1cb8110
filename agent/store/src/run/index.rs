//! The index of a run: a summary of every record, in SQLite, rebuilt wherever it disagrees with the folder.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use rusqlite::{Connection, params};

use super::{EpisodeSummary, record_path, recorded};
use crate::record::EpisodeRecord;

/// The index's file in the run's folder.
pub const INDEX: &str = "index.sqlite";
/// Rises when summaries change; an index of another version is rebuilt.
const INDEX_VERSION: i64 = 3;
/// How long a writer waits for another process that reads.
const WAIT_SECS: u64 = 30;

/// Opens the index and makes it say what the folder holds.
pub fn open(folder: &Path) -> Result<Connection> {
    let path = folder.join(INDEX);
    match open_file(&path).and_then(|index| reconcile(&index, folder).map(|()| index)) {
        Ok(index) => Ok(index),
        // The records are the truth, so a damaged index is no loss. A damaged record is, and fails again below.
        Err(error) => {
            tracing::warn!("the index {} is rebuilt: {error:#}", path.display());
            std::fs::remove_file(&path)
                .with_context(|| format!("cannot remove {}", path.display()))?;
            let index = open_file(&path)?;
            reconcile(&index, folder)?;
            Ok(index)
        }
    }
}

fn open_file(path: &Path) -> Result<Connection> {
    let index =
        Connection::open(path).with_context(|| format!("cannot open {}", path.display()))?;
    index.busy_timeout(Duration::from_secs(WAIT_SECS))?;
    let version: i64 = index.query_row("PRAGMA user_version", [], |row| row.get(0))?;
    ensure!(
        version == INDEX_VERSION || version == 0,
        "expected index version {INDEX_VERSION}, got {version}"
    );
    index.pragma_update(None, "user_version", INDEX_VERSION)?;
    index.execute_batch(
        "PRAGMA synchronous = OFF; -- rebuildable
         CREATE TABLE IF NOT EXISTS episodes (
             id TEXT PRIMARY KEY, task TEXT NOT NULL, episode INTEGER NOT NULL, strategy TEXT NOT NULL,
             candidates INTEGER NOT NULL, temperature REAL NOT NULL, is_success INTEGER NOT NULL, summary TEXT NOT NULL)",
    )?;
    Ok(index)
}

/// Makes the index say what the folder holds.
fn reconcile(index: &Connection, folder: &Path) -> Result<()> {
    let in_folder = recorded(folder)?;
    let mut statement = index.prepare("SELECT id FROM episodes")?;
    let in_index = statement
        .query_map([], |row| row.get(0))?
        .collect::<rusqlite::Result<BTreeSet<String>>>()?;
    let transaction = index.unchecked_transaction()?;
    for id in in_index.difference(&in_folder) {
        transaction.execute("DELETE FROM episodes WHERE id = ?1", [id])?;
    }
    for id in in_folder.difference(&in_index) {
        let path = record_path(folder, id);
        let record = EpisodeRecord::read(&path)?;
        let named = record.identity.id();
        ensure!(named == *id, "{}: expected the episode of that name, got {named}", path.display());
        insert(&transaction, &record)?;
    }
    Ok(transaction.commit()?)
}

/// Adds a record's summary.
pub fn insert(index: &Connection, record: &EpisodeRecord) -> Result<()> {
    let identity = &record.identity;
    let summary = serde_json::to_string(&EpisodeSummary::from(record))?;
    index.execute(
        "INSERT OR REPLACE INTO episodes VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)",
        params![
            identity.id(),
            identity.task,
            identity.episode,
            identity.strategy,
            identity.candidates,
            identity.temperature,
            record.statistics.is_success,
            summary
        ],
    )?;
    Ok(())
}

/// All summaries, ordered by the episodes' names.
pub fn summaries(index: &Connection) -> Result<Vec<EpisodeSummary>> {
    let mut statement = index.prepare("SELECT summary FROM episodes ORDER BY id")?;
    let texts = statement.query_map([], |row| row.get::<_, String>(0))?;
    texts
        .map(|text| {
            serde_json::from_str(&text?).context("the index holds a summary of another version")
        })
        .collect()
}
