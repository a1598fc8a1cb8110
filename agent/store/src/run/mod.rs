//! A run is a folder: its options and versions, one record per finished episode, an index, a lock.
//!
//! ```text
//! run.json            options, commands and builds; resuming may only add settings and episodes
//! episodes/{id}.msgpack   the source of truth: one complete file per finished episode, with a
//! checksum
//! episodes/{id}.msgpack.damaged   a damaged record that was set aside; its episode is run again
//! index.sqlite        a summary of every record; recreated whenever the run is opened
//! faults.jsonl        one line per failed attempt; never a label
//! videos/{id}.mp4     if requested
//! lock                held by the one process that writes
//! ```
//!
//! [`Run`] is the writer. The functions beside it are read-only and may be called while another
//! process writes.

mod faults;
mod header;
mod index;
mod records;
mod summary;
mod writer;

use std::path::Path;

use anyhow::Result;

pub use faults::{FaultRecord, faults};
pub use header::{RunHeader, RunStart, read_header};
pub use records::{record_path, recorded, video_path, write_video};
pub use summary::EpisodeSummary;
pub use writer::{Run, RunRequest};

use crate::record::ReadError;

/// All recorded episodes of a run, ordered by name; another process may be writing. Damaged records
/// are ignored with a warning.
pub fn summaries(folder: &Path) -> Result<Vec<EpisodeSummary>> {
    let ids = recorded(folder)?;
    let mut indexed = index::read(folder).unwrap_or_else(|error| {
        tracing::debug!("the index of {} is not used: {error:#}", folder.display());
        Default::default()
    });
    indexed.retain(|id, _| ids.contains(id));
    let missing: Vec<String> = ids.into_iter().filter(|id| !indexed.contains_key(id)).collect();
    for (id, read) in missing.iter().zip(records::read_all(folder, &missing)) {
        match read {
            Ok(entry) => {
                indexed.insert(id.clone(), entry.summary);
            }
            // The writer has set it aside in the meantime.
            Err(ReadError::Unreadable { source, .. })
                if source.kind() == std::io::ErrorKind::NotFound => {}
            Err(error @ ReadError::Damaged { .. }) => {
                tracing::warn!("ignored a record: {error}")
            }
            Err(error) => return Err(error.into()),
        }
    }
    Ok(indexed.into_values().collect())
}
