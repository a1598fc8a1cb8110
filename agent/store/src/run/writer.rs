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

/// What a run is asked for.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RunRequest {
    /// Where it is kept.
    pub folder: PathBuf,
    /// The label store that it feeds; none for a run that is thrown away.
    pub labels: Option<PathBuf>,
    /// Everything that decides the results, by name.
    pub options: Value,
    /// Versions of everything that the results depend on, by name.
    pub versions: Value,
    /// The command line, word by word.
    pub command: Vec<String>,
    /// The program.
    pub build: Build,
}

/// A run that this process may write. Every call blocks on the disk, so callers make them on a thread of their own.
#[derive(Debug)]
pub struct Run {
    /// Where it is kept, from the root.
    pub folder: PathBuf,
    /// What it is.
    pub header: RunHeader,
    /// What every record of this process says of itself.
    provenance: Provenance,
    /// The index, with the label store attached to it.
    connection: Connection,
    labels: Option<PathBuf>,
    /// Recorded episodes that index and label store lack.
    incomplete: RefCell<BTreeSet<String>>,
    _lock: Lock,
}

impl Run {
    /// Starts a run, or resumes the one in the folder when it has the same options and versions; more settings and more
    /// episodes are added to it. Afterwards index and label store say what the records say.
    pub fn open(request: &RunRequest) -> Result<Run> {
        let name = request.folder.display();
        std::fs::create_dir_all(request.folder.join(EPISODES))
            .with_context(|| format!("cannot make the run {name}"))?;
        // Labels name records; they must be found from any working folder.
        let folder = std::path::absolute(&request.folder)
            .with_context(|| format!("cannot find the folder {name}"))?;
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

    /// Makes an episode durable: its record first, then its summary and its label in one transaction. Where only the second
    /// fails, nothing is lost; it is said and tried again in [`Run::complete`] and at the next start.
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
                tracing::warn!("{id} is recorded, but its label is not written yet: {error:#}");
                self.incomplete.borrow_mut().insert(id)
            }
        };
        Ok(())
    }

    /// Notes an attempt that broke.
    pub fn fault(&self, fault: &FaultRecord) -> Result<()> {
        faults::append(&self.folder, fault)
    }

    /// All recorded episodes, ordered by name.
    pub fn summaries(&self) -> Result<Vec<EpisodeSummary>> {
        super::summaries(&self.folder)
    }

    /// Writes the labels that could not be written before. What is missing when this fails is completed at the next start.
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
                "{count} recorded episodes of the run {run} have no label; rerun the same command"
            )
        })?;
        self.incomplete.borrow_mut().clear();
        Ok(())
    }

    fn attach_labels(&self) -> Result<()> {
        let Some(path) = &self.labels else { return Ok(()) };
        let name = path.display();
        // Made, and checked for being one, by itself.
        LabelStore::open(path)?;
        let text = path.to_str().with_context(|| format!("{name}: expected a path in UTF-8"))?;
        self.connection
            .execute("ATTACH DATABASE ?1 AS store", [text])
            .with_context(|| format!("cannot open the label store {name}"))?;
        Ok(())
    }

    /// Makes index and label store say what the records say, in one transaction.
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
                    "label store {}: {changed} labels of the run {} said something else than their records and were \
                     corrected, {removed} had no record and were removed",
                    path.display(),
                    self.header.run
                );
            }
        }
        transaction.commit().context("cannot write the index and the label store")
    }

    /// Puts episodes into index and label store, all or none.
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

    /// A transaction over all files that has their locks from its start, so that it cannot fail for one halfway.
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

/// Released by the system when the process ends, however it ends.
#[derive(Debug)]
struct Lock(File);

impl Drop for Lock {
    /// A child that is being started holds a copy of every file until it runs its own program: closing ours would
    /// leave the run locked for that long, unlocking releases it at once.
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
