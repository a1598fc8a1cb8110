//! The memory of one client's episode: the same [`EpisodeContext`] as in a rollout.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use batching::Answer;
use decision::{Decision, EpisodeContext, Observation};

use super::agent::ServedAgent;
use crate::codec::extension::Ask;

/// One client's current episode.
pub struct Session {
    agent: Arc<ServedAgent>,
    /// None between episodes and after a fault.
    context: Option<EpisodeContext>,
}

/// A decision and its time.
pub(super) struct Decided {
    pub decision: Decision,
    pub batch_time: Duration,
}

impl Session {
    /// A session without an episode.
    pub fn new(agent: Arc<ServedAgent>) -> Session {
        Session { agent, context: None }
    }

    pub(super) fn agent(&self) -> &ServedAgent {
        &self.agent
    }

    /// Whether an episode is running.
    pub(super) fn is_running(&self) -> bool {
        self.context.is_some()
    }

    /// Begins an episode; that of before is forgotten.
    pub(super) fn begin(&mut self, episode: &str, instruction: &str) {
        self.context = Some(self.agent.begin(episode, instruction));
    }

    /// Ends the episode.
    pub(super) fn end(&mut self) {
        self.context = None;
    }

    /// Decides together with the other clients that wait. A fault ends the episode's memory.
    pub(super) async fn decide(&mut self, observation: Observation, ask: &Ask) -> Result<Decided> {
        let setting = self.agent.setting(ask)?;
        let mut context = self.context.take().context("expected a running episode, got none")?;
        context.setting = setting;
        context.decision_seed = ask.seed;
        context.instruction.clone_from(&observation.instruction);
        let answer = self.agent.batcher.decide(observation, context).await;
        let answer = answer.context("the decision failed; the server's log says why")?;
        let Answer { context, decision, batch_time, .. } = answer;
        let decision = decision?;
        self.context = Some(context);
        Ok(Decided { decision, batch_time })
    }
}
