//! A running episode: only what a reset returned can step.

use protocol::limits::ACTION_LENGTH;
use protocol::{Observation, Reply, Request, Transition};

use super::environment::unexpected;
use super::{Environment, EnvironmentFault};

/// Owns its environment until [`Episode::finish`]. After any fault but `Refused` it is void: drop it.
#[derive(Debug)]
pub struct Episode {
    environment: Environment,
    observation: Observation,
}

impl Episode {
    pub(super) fn new(environment: Environment, observation: Observation) -> Self {
        Self { environment, observation }
    }

    /// What the policy sees now.
    pub fn observation(&self) -> &Observation {
        &self.observation
    }

    /// The server's id.
    pub fn server(&self) -> &str {
        self.environment.server()
    }

    /// One control step.
    pub async fn step(
        &mut self,
        action: [f32; ACTION_LENGTH],
    ) -> Result<Transition, EnvironmentFault> {
        match self.environment.ask("Step", |sequence| Request::Step { sequence, action }).await? {
            Reply::Stepped { transition, .. } => {
                self.observe(transition.observation.clone())?;
                Ok(transition)
            }
            other => Err(unexpected("Stepped", &other)),
        }
    }

    /// Has the last reply sent once more; the world does not move. It costs what the wire costs, without a simulator.
    pub async fn repeat(&mut self) -> Result<(), EnvironmentFault> {
        self.environment.ask_again("the last request again").await.map(drop)
    }

    /// Keeps the present state in `slot` until the episode's end.
    pub async fn save(&mut self, slot: u32) -> Result<(), EnvironmentFault> {
        match self.environment.ask("Save", |sequence| Request::Save { sequence, slot }).await? {
            Reply::Saved { .. } => Ok(()),
            other => Err(unexpected("Saved", &other)),
        }
    }

    /// Goes back to the state in `slot`, bit by bit.
    pub async fn restore(&mut self, slot: u32) -> Result<(), EnvironmentFault> {
        match self
            .environment
            .ask("Restore", |sequence| Request::Restore { sequence, slot })
            .await?
        {
            Reply::Restored { observation, .. } => self.observe(observation),
            other => Err(unexpected("Restored", &other)),
        }
    }

    /// Ends the episode; the session can start another one.
    pub fn finish(self) -> Environment {
        self.environment
    }

    fn observe(&mut self, observation: Observation) -> Result<(), EnvironmentFault> {
        self.environment.check_image(&observation.image)?;
        self.observation = observation;
        Ok(())
    }
}
