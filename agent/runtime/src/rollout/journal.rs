//! What is kept of attempts: first the record on disk, then the published outcome.

use anyhow::{Context, Result};

use super::queue::Job;
use store::labels::outcome;
use crate::progress::Progress;
use store::record::{EpisodeRecord, write_whole};
use store::run::{FaultRecord, Run};
use crate::wire::{EnvironmentFault, OutcomePublisher};

/// The one writer of a run.
pub struct Journal {
    /// On disk.
    pub run: Run,
    /// To whoever collects labels.
    pub outcomes: OutcomePublisher,
    /// To whoever watches.
    pub progress: Progress,
}

impl Journal {
    /// Keeps an episode that ran to its end. A label that is published has its record, whatever happens next.
    pub async fn record(&mut self, record: &EpisodeRecord, video: Option<&[u8]>) -> Result<()> {
        if let Some(video) = video {
            let path = self.run.video_path(&record.identity.id());
            let folder = path.parent().context("a video has a folder")?;
            std::fs::create_dir_all(folder)
                .with_context(|| format!("cannot make {}", folder.display()))?;
            write_whole(&path, video)?;
        }
        self.run.record(record)?;
        self.outcomes.publish(&outcome(record)).await?;
        self.progress.recorded(record.statistics.is_success, record.steps.len());
        Ok(())
    }

    /// Notes an attempt that broke.
    pub fn fault(&mut self, job: &Job, server: &str, fault: &EnvironmentFault) -> Result<()> {
        let reason = fault.to_string();
        self.progress.faulted(&format!(
            "{} (attempt {}): {reason}",
            job.identity.id(),
            job.attempt
        ));
        let identity = job.identity.clone();
        self.run.fault(&FaultRecord {
            identity,
            attempt: job.attempt,
            server: server.to_owned(),
            reason,
        })
    }
}
