//! Writes records, labels and faults into the run's folder.

use anyhow::Result;
use store::run::Run;

use super::{Event, EventSink};

/// The only writer of a run.
pub struct StoreSink {
    run: Run,
}

impl StoreSink {
    /// Writes into `run`.
    pub fn new(run: Run) -> StoreSink {
        StoreSink { run }
    }
}

impl EventSink for StoreSink {
    fn on(&mut self, event: &Event) -> Result<()> {
        match event {
            Event::Recorded(record) => self.run.record(record),
            Event::Faulted(fault) => self.run.fault(fault),
            Event::Started { .. } | Event::Stepped { .. } | Event::Notice(_) => Ok(()),
        }
    }

    fn finish(&mut self) -> Result<()> {
        self.run.complete()
    }
}
