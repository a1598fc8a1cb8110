//! The writer of a run: one process, one object, blocking calls.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::fs::{File, OpenOptions, TryLockError};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use rusqlite::Connection;
use serde_json::Value;

use super::records::{self, EPISODES, Entry};
use super::{EpisodeSummary, FaultRecord, RunHeader, faults, header, index, record_path};
use crate::labels::{self, LabelStore};
use crate::provenance::{Build, Provenance};
use crate::record::EpisodeRecord;

/// The request to start or resume a run.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RunRequest {
    /// Folder of the run.
    pub folder: PathBuf,
    /// The label store that receives the run's labels; `None` for a temporary run.
    pub labels: Option<PathBuf>,
    /// Everything that determines the results, by name.
    pub options: Value,
    /// Versions of everything that affects the results, by name.
    pub versions: Value,
    /// As [`RunHeader::served`].
    pub served: Option<Value>,
    /// The command line, word by word.
    pub command: Vec<String>,
    /// The program.
    pub build: Build,
}

/// A run that this process may write. Every call blocks on the disk, so it belongs on its own
/// thread.
#[derive(Debug)]
pub struct Run {
    /// Absolute path of the folder.
    pub folder: PathBuf,
    /// The header of the run.
    pub header: RunHeader,
    /// The provenance of all records of this process.
    provenance: Provenance,
    /// The index, with the label store attached.
    connection: Connection,
    labels: Option<PathBuf>,
    /// Recorded episodes that are missing in the index and the label store.
    incomplete: RefCell<BTreeSet<String>>,
    _lock: Lock,
}

impl Run {
    /// Starts a run, or resumes the one in the folder if it has the same options and versions;
    /// additional settings and episodes are added to it. Afterwards the index and the label store
    /// agree with the records.
    pub fn open(request: &RunRequest) -> Result<Run> {
        let name = request.folder.display();
        std::fs::create_dir_all(request.folder.join(EPISODES))
            .with_context(|| format!("cannot create the run {name}"))?;
        // Labels contain paths of records, which must be valid from any working folder.
        let folder = std::path::absolute(&request.folder)
            .with_context(|| format!("cannot resolve the folder {name}"))?;
        ensure!(folder.to_str().is_some(), "the run {name}: expected a path in UTF-8");
        let lock = lock(&folder)?;
        let header = header::settle(request, !records::recorded(&folder)?.is_empty())?;
        records::remove_unfinished(&folder)?;
        faults::cut_unfinished(&folder)?;
        let provenance = Provenance {
            command: request.command.clone(),
            options: request.options.clone(),
            build: request.build.clone(),
        };
        let run = Run {
            connection: index::create(&folder)?,
            folder,
            header,
            provenance,
            labels: request.labels.clone(),
            incomplete: RefCell::default(),
            _lock: lock,
        };
        run.attach_labels()?;
        run.reconcile()?;
        Ok(run)
    }

    /// Makes an episode durable: first its record, then its summary and its label in one
    /// transaction. If only the transaction fails, nothing is lost: a warning is logged and the
    /// transaction is retried in [`Run::complete`] and when the run is resumed.
    pub fn record(&self, record: &EpisodeRecord) -> Result<()> {
        let (id, run) = (record.identity.id(), &self.header.run);
        ensure!(
            record.identity.run == *run,
            "episode {id}: expected a record of the run {run}, got {}",
            record.identity.run
        );
        let path = record_path(&self.folder, &id);
        record.write(&path, &self.provenance)?;
        match self.index(&[Entry::new(record, &path)]) {
            Ok(()) => self.incomplete.borrow_mut().remove(&id),
            Err(error) => {
                tracing::warn!(
                    "{id} is recorded, but its label could not be written yet: {error:#}"
                );
                self.incomplete.borrow_mut().insert(id)
            }
        };
        Ok(())
    }

    /// Records a failed attempt.
    pub fn fault(&self, fault: &FaultRecord) -> Result<()> {
        faults::append(&self.folder, fault)
    }

    /// All recorded episodes, ordered by name.
    pub fn summaries(&self) -> Result<Vec<EpisodeSummary>> {
        super::summaries(&self.folder)
    }

    /// Writes the labels that could not be written before. If this fails, they are written when the
    /// run is resumed.
    pub fn complete(&self) -> Result<()> {
        let ids = Vec::from_iter(self.incomplete.borrow().iter().cloned());
        if ids.is_empty() {
            return Ok(());
        }
        let complete = || -> Result<()> {
            let entries = records::read_all(&self.folder, &ids).into_iter();
            self.index(&entries.collect::<Result<Vec<Entry>, _>>()?)
        };
        complete().with_context(|| {
            let (count, run) = (ids.len(), &self.header.run);
            format!(
                "{count} recorded episodes of the run {run} have no label yet; rerun the same command to write them"
            )
        })?;
        self.incomplete.borrow_mut().clear();
        Ok(())
    }

    fn attach_labels(&self) -> Result<()> {
        let Some(path) = &self.labels else { return Ok(()) };
        let name = path.display();
        // Opening it separately creates it and checks that it is a label store.
        LabelStore::open(path)?;
        let text = path.to_str().with_context(|| format!("{name}: expected a path in UTF-8"))?;
        self.connection
            .execute("ATTACH DATABASE ?1 AS store", [text])
            .with_context(|| format!("cannot open the label store {name}"))?;
        Ok(())
    }

    /// Makes the index and the label store agree with the records, in one transaction.
    fn reconcile(&self) -> Result<()> {
        let entries = records::check_all(&self.folder, &self.header.run)?;
        let transaction = self.begin()?;
        for entry in &entries {
            index::insert(&self.connection, &entry.summary)?;
        }
        if let Some(path) = &self.labels {
            let expected: Vec<_> = entries.into_iter().filter_map(|entry| entry.label).collect();
            let labels::Corrections { changed, removed } =
                labels::reconcile(&self.connection, &self.header.run, &self.folder, &expected)?;
            if changed + removed > 0 {
                tracing::warn!(
                    "label store {}: corrected {changed} labels of the run {} that differed from their \
                     records, removed {removed} labels without a record",
                    path.display(),
                    self.header.run
                );
            }
        }
        transaction.commit().context("cannot write the index and the label store")
    }

    /// Adds episodes to the index and the label store, all or none.
    fn index(&self, entries: &[Entry]) -> Result<()> {
        let transaction = self.begin()?;
        for entry in entries {
            index::insert(&self.connection, &entry.summary)?;
            if let (Some(_), Some(label)) = (&self.labels, &entry.label) {
                labels::insert(&self.connection, label)?;
            }
        }
        transaction.commit().with_context(|| self.databases())
    }

    /// A transaction over both files that locks both at its start, so that it cannot fail halfway.
    fn begin(&self) -> Result<rusqlite::Transaction<'_>> {
        let behavior = rusqlite::TransactionBehavior::Immediate;
        rusqlite::Transaction::new_unchecked(&self.connection, behavior)
            .with_context(|| self.databases())
    }

    fn databases(&self) -> String {
        let labels =
            self.labels.as_ref().map(|path| format!(" or the label store {}", path.display()));
        format!("cannot write the index of {}{}", self.folder.display(), labels.unwrap_or_default())
    }
}

/// The operating system releases the lock when the process ends.
#[derive(Debug)]
struct Lock(File);

impl Drop for Lock {
    /// A child process that is being started has a copy of every open file until it executes its
    /// own program. Closing our file would leave the run locked until then; unlocking releases it
    /// at once.
    fn drop(&mut self) {
        let _ = self.0.unlock();
    }
}

fn lock(folder: &Path) -> Result<Lock> {
    let path = folder.join("lock");
    let file = OpenOptions::new().create(true).truncate(false).write(true).open(&path);
    let file = file.with_context(|| format!("cannot open {}", path.display()))?;
    match file.try_lock() {
        Ok(()) => Ok(Lock(file)),
        Err(TryLockError::WouldBlock) => {
            bail!("the run {} is being written by another process", folder.display())
        }
        Err(TryLockError::Error(error)) => {
            Err(error).with_context(|| format!("cannot lock {}", path.display()))
        }
    }
}

#[cfg(test)]
mod tests;
