//! Publishes outcomes for observers.

use anyhow::Result;
use store::labels::outcome;

use super::{Event, EventSink};
use crate::wire::OutcomePublisher;

/// Publishes what came of every recorded episode. An observer that cannot be reached ends no run.
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
            tracing::warn!("an outcome was not published: {error:#}");
        }
        Ok(())
    }
}
