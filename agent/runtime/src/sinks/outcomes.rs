//! Publishes outcomes for observers.

use anyhow::Result;
use store::labels::outcome;

use super::{Event, EventSink};
use crate::wire::OutcomePublisher;

/// Publishes the outcome of every recorded episode. A failure to publish does not end the run.
pub struct OutcomeSink {
    publisher: OutcomePublisher,
}

impl OutcomeSink {
    /// Publishes with `publisher`.
    pub fn new(publisher: OutcomePublisher) -> OutcomeSink {
        OutcomeSink { publisher }
    }
}

impl EventSink for OutcomeSink {
    fn on(&mut self, event: &Event) -> Result<()> {
        if let Event::Recorded(record) = event
            && let Err(error) = self.publisher.publish(&outcome(record))
        {
            tracing::warn!("{error:#}");
        }
        Ok(())
    }
}
