//! The faults of a run: one line of JSON per failed attempt.

use std::fs::OpenOptions;
use std::io::Write;
use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use crate::queue::FaultScope;
use crate::record::EpisodeIdentity;

pub(super) const FAULTS: &str = "faults.jsonl";

/// A failed attempt. It is never a label.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FaultRecord {
    /// The episode of the attempt.
    pub identity: EpisodeIdentity,
    /// 1 for the first attempt of this process.
    pub attempt: u32,
    /// The server on which it failed.
    pub server: String,
    /// What the fault affects.
    pub scope: FaultScope,
    /// What happened.
    pub reason: String,
}

/// All failed attempts of a run. Unreadable lines are ignored with a warning, because only the
/// number of faults is used. A line that a killed process left incomplete is not a fault.
pub fn faults(folder: &Path) -> Result<Vec<FaultRecord>> {
    let path = folder.join(FAULTS);
    if !path.exists() {
        return Ok(Vec::new());
    }
    let name = path.display();
    let text = std::fs::read(&path).with_context(|| format!("cannot read {name}"))?;
    let (mut faults, mut unreadable) = (Vec::new(), Vec::new());
    let lines = text.split_inclusive(|byte| *byte == b'\n');
    for (index, line) in lines.enumerate().filter(|(_, line)| line.ends_with(b"\n")) {
        match serde_json::from_slice(line) {
            Ok(fault) => faults.push(fault),
            Err(error) => unreadable.push(format!("line {}: {error}", index + 1)),
        }
    }
    if let Some(first) = unreadable.first() {
        tracing::warn!(
            "{name}: ignored {} unreadable lines, the first is {first}",
            unreadable.len()
        );
    }
    Ok(faults)
}

/// Appends a fault and syncs the file.
pub(super) fn append(folder: &Path, fault: &FaultRecord) -> Result<()> {
    let path = folder.join(FAULTS);
    let mut line = serde_json::to_vec(fault)?;
    line.push(b'\n');
    let write = || -> std::io::Result<()> {
        let mut file = OpenOptions::new().create(true).append(true).open(&path)?;
        file.write_all(&line)?;
        file.sync_all()
    };
    write().with_context(|| format!("cannot write {}", path.display()))
}

/// Removes an incomplete last line of a killed process, so that the next line starts correctly.
pub(super) fn cut_unfinished(folder: &Path) -> Result<()> {
    let path = folder.join(FAULTS);
    if !path.exists() {
        return Ok(());
    }
    let text = std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let whole = text.iter().rposition(|byte| *byte == b'\n').map_or(0, |last| last + 1);
    let cut = || OpenOptions::new().write(true).open(&path)?.set_len(whole as u64);
    cut().with_context(|| format!("cannot write {}", path.display()))
}
