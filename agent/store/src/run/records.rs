//! The records in a run's folder: their paths, their names, and the handling of damaged ones.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::thread;

use anyhow::{Context, Result, bail};

use super::EpisodeSummary;
use crate::durable::{TEMPORARY_PREFIX, write_whole};
use crate::labels::Label;
use crate::record::{EpisodeRecord, ReadError};

pub(super) const EPISODES: &str = "episodes";
pub(super) const VIDEOS: &str = "videos";
const RECORD_SUFFIX: &str = ".msgpack";
/// Suffix of a record that was set aside.
const DAMAGED_SUFFIX: &str = ".damaged";

/// The data of a record in the index and the label store.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Entry {
    pub summary: EpisodeSummary,
    /// `None` if the episode has no outcome because the policy never acted.
    pub label: Option<Label>,
}

impl Entry {
    pub fn new(record: &EpisodeRecord, path: &Path) -> Entry {
        Entry {
            summary: EpisodeSummary::from(record),
            label: record.has_outcome().then(|| Label::new(record, path)),
        }
    }

    /// Reads a record and checks that its content matches its file name.
    pub fn read(folder: &Path, id: &str) -> Result<Entry, ReadError> {
        let path = record_path(folder, id);
        let record = EpisodeRecord::read(&path)?;
        let named = record.identity.id();
        if named != id {
            let reason = format!("expected the episode in its file name, got {named}");
            return Err(ReadError::Damaged { path, reason });
        }
        Ok(Entry::new(&record, &path))
    }
}

/// Path of an episode's record.
pub fn record_path(folder: &Path, id: &str) -> PathBuf {
    folder.join(EPISODES).join(format!("{id}{RECORD_SUFFIX}"))
}

/// Path of an episode's video, if there is one.
pub fn video_path(folder: &Path, id: &str) -> PathBuf {
    folder.join(VIDEOS).join(format!("{id}.mp4"))
}

/// Writes the video of an episode. It is written before the record, so that a record's video always
/// exists.
pub fn write_video(folder: &Path, id: &str, video: &[u8]) -> Result<()> {
    let videos = folder.join(VIDEOS);
    std::fs::create_dir_all(&videos)
        .with_context(|| format!("cannot create {}", videos.display()))?;
    write_whole(&video_path(folder, id), video)
}

/// The names of all recorded episodes according to the folder, independent of the index.
pub fn recorded(folder: &Path) -> Result<BTreeSet<String>> {
    let episodes = folder.join(EPISODES);
    let read = || -> std::io::Result<BTreeSet<String>> {
        let mut names = BTreeSet::new();
        for entry in std::fs::read_dir(&episodes)? {
            let name = entry?.file_name();
            names.extend(
                name.to_str().and_then(|name| name.strip_suffix(RECORD_SUFFIX)).map(str::to_owned),
            );
        }
        Ok(names)
    };
    read().with_context(|| format!("cannot read {}", episodes.display()))
}

/// Reads and checks the records of these episodes in parallel; returns them in the same order.
pub(super) fn read_all(folder: &Path, ids: &[String]) -> Vec<Result<Entry, ReadError>> {
    let threads = thread::available_parallelism().map_or(1, usize::from);
    let part = ids.len().div_ceil(threads).max(1);
    let read = |ids: &[String]| ids.iter().map(|id| Entry::read(folder, id)).collect::<Vec<_>>();
    thread::scope(|scope| {
        let parts: Vec<_> = ids.chunks(part).map(|ids| scope.spawn(move || read(ids))).collect();
        let joined = parts.into_iter().map(|part| part.join());
        joined
            .flat_map(|part| part.unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            .collect()
    })
}

/// Reads all records of the run `run` for its writer. A damaged record is set aside, so that its
/// episode is run again.
pub(super) fn check_all(folder: &Path, run: &str) -> Result<Vec<Entry>> {
    let ids: Vec<String> = recorded(folder)?.into_iter().collect();
    let mut entries = Vec::with_capacity(ids.len());
    for (id, read) in ids.iter().zip(read_all(folder, &ids)) {
        let path = record_path(folder, id);
        let reason = match read {
            Ok(entry) if entry.summary.identity.run == run => {
                entries.push(entry);
                continue;
            }
            Ok(entry) => {
                format!("expected a record of the run {run}, got {}", entry.summary.identity.run)
            }
            Err(ReadError::Damaged { reason, .. }) => reason,
            Err(error @ ReadError::OtherVersion { .. }) => {
                bail!("{error}; choose another folder (--out)")
            }
            Err(error) => return Err(error.into()),
        };
        let aside = folder.join(EPISODES).join(format!("{id}{RECORD_SUFFIX}{DAMAGED_SUFFIX}"));
        std::fs::rename(&path, &aside)
            .with_context(|| format!("cannot rename {}", path.display()))?;
        tracing::warn!(
            "{id}: renamed its damaged record to {}; the episode is run again: {reason}",
            aside.display()
        );
    }
    Ok(entries)
}

/// Removes the incomplete files of a killed process.
pub(super) fn remove_unfinished(folder: &Path) -> Result<()> {
    let folders = [folder.to_path_buf(), folder.join(EPISODES), folder.join(VIDEOS)];
    for folder in folders.iter().filter(|folder| folder.exists()) {
        let remove = || -> std::io::Result<()> {
            for entry in std::fs::read_dir(folder)? {
                let entry = entry?;
                if entry.file_name().to_string_lossy().starts_with(TEMPORARY_PREFIX) {
                    std::fs::remove_file(entry.path())?;
                }
            }
            Ok(())
        };
        remove()
            .with_context(|| format!("cannot remove unfinished files in {}", folder.display()))?;
    }
    Ok(())
}
