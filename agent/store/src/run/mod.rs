//! A run is a folder: its options and versions, one record per finished episode, an index, a lock.
//!
//! ```text
//! run.json            what was asked for, by which commands and builds; a second start may only ask for more of the same
//! episodes/{id}.msgpack   the truth: one whole file per finished episode, with a checksum
//! episodes/{id}.msgpack.damaged   a record that was set aside; its episode is run again
//! index.sqlite        a summary of every record; made anew at every start
//! faults.jsonl        one line per attempt that broke; never a label
//! videos/{id}.mp4     when asked for
//! lock                held by the one process that writes
//! ```
//!
//! [`Run`] is the writer. All functions beside it read, change nothing, and may be called while another process writes.

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

/// All recorded episodes of a run that another process may be writing, ordered by name. Damaged records are left out with a
/// warning.
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
            // Its writer has set it aside meanwhile.
            Err(ReadError::Unreadable { source, .. })
                if source.kind() == std::io::ErrorKind::NotFound => {}
            Err(error @ ReadError::Damaged { .. }) => {
                tracing::warn!("a record is not counted: {error}")
            }
            Err(error) => return Err(error.into()),
        }
    }
    Ok(indexed.into_values().collect())
}
