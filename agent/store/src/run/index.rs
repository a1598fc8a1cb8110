//! The index of a run: a summary of every record in SQLite, so that tables need not read the
//! records.
//!
//! Only the holder of the run's lock creates or changes the index. Other processes open it
//! read-only and read the records themselves if the index is unusable.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use rusqlite::{Connection, OpenFlags, params};
use sha2::{Digest, Sha256};

use super::EpisodeSummary;
use crate::digest::hex;
use crate::labels::WAIT;

/// The index's file in the run's folder.
pub(super) const INDEX: &str = "index.sqlite";
/// Increases when the schema changes; an index of another version is not used.
const INDEX_VERSION: i64 = 3;
/// How long a reader waits for a transaction before it reads the records instead.
const READER_WAIT: Duration = Duration::from_secs(2);

/// Creates an empty index in place of an existing one. Only the holder of the run's lock may do so.
pub(super) fn create(folder: &Path) -> Result<Connection> {
    let path = folder.join(INDEX);
    // The journal of a killed process belongs to the old index.
    for name in [INDEX.to_owned(), format!("{INDEX}-journal")] {
        let old = folder.join(name);
        if old.exists() {
            std::fs::remove_file(&old)
                .with_context(|| format!("cannot remove {}", old.display()))?;
        }
    }
    let create = || -> rusqlite::Result<Connection> {
        let index = Connection::open(&path)?;
        index.busy_timeout(WAIT)?;
        index.execute_batch(
            "CREATE TABLE episodes (id TEXT PRIMARY KEY, summary TEXT NOT NULL, sha256 TEXT NOT NULL)",
        )?;
        index.pragma_update(None, "user_version", INDEX_VERSION)?;
        Ok(index)
    };
    create().with_context(|| format!("cannot create {}", path.display()))
}

/// Inserts a summary, replacing an earlier one of the episode.
pub(super) fn insert(index: &Connection, summary: &EpisodeSummary) -> Result<()> {
    let text = serde_json::to_string(summary)?;
    let sha256 = hex(&Sha256::digest(&text));
    let mut statement =
        index.prepare_cached("INSERT OR REPLACE INTO episodes VALUES (?1, ?2, ?3)")?;
    statement.execute(params![summary.identity.id(), text, sha256])?;
    Ok(())
}

/// All summaries by episode name, from an index that another process may be writing. Read-only.
pub(super) fn read(folder: &Path) -> Result<BTreeMap<String, EpisodeSummary>> {
    let index = Connection::open_with_flags(folder.join(INDEX), OpenFlags::SQLITE_OPEN_READ_ONLY)?;
    index.busy_timeout(READER_WAIT)?;
    let version: i64 = index.query_row("PRAGMA user_version", [], |row| row.get(0))?;
    ensure!(version == INDEX_VERSION, "expected index version {INDEX_VERSION}, got {version}");
    summaries(&index)
}

/// All summaries by episode name.
pub(super) fn summaries(index: &Connection) -> Result<BTreeMap<String, EpisodeSummary>> {
    let mut statement = index.prepare("SELECT id, summary, sha256 FROM episodes")?;
    let rows = statement.query_map([], |row| Ok((row.get(0)?, row.get(1)?, row.get(2)?)))?;
    let mut summaries = BTreeMap::new();
    for row in rows {
        let (id, text, sha256): (String, String, String) = row?;
        // SQLite detects damage of its own structure, but not of the stored values.
        ensure!(hex(&Sha256::digest(&text)) == sha256, "the row of {id} is damaged");
        let summary: EpisodeSummary =
            serde_json::from_str(&text).with_context(|| format!("the row of {id}"))?;
        ensure!(summary.identity.id() == id, "the row of {id} contains another episode");
        summaries.insert(id, summary);
    }
    Ok(summaries)
}
