//! A running episode: only the result of a reset can step.

use std::mem;
use std::time::Duration;

use protocol::{Observation, Reply, Request, Transition};

use super::Environment;
use super::environment::unexpected;
use crate::fault::EnvironmentFault;
use crate::session;

/// Owns its environment until [`Episode::finish`]. After any fault except `Refused` it is void and
/// must be dropped.
#[derive(Debug)]
pub struct Episode {
    environment: Environment,
    observation: Observation,
    simulator_time: Duration,
}

impl Episode {
    pub(super) fn new(
        environment: Environment,
        observation: Observation,
    ) -> Result<Self, EnvironmentFault> {
        environment.check_image(&observation.image)?;
        Ok(Self { environment, observation, simulator_time: Duration::ZERO })
    }

    /// The current observation.
    pub fn observation(&self) -> &Observation {
        &self.observation
    }

    /// The server's id.
    pub fn server(&self) -> &str {
        self.environment.server()
    }

    /// Executes one control step.
    pub async fn step(&mut self, action: &[f32]) -> Result<Transition, EnvironmentFault> {
        let request = |sequence| Request::Step { sequence, action: action.to_vec() };
        match self.environment.ask("Step", request).await? {
            Reply::Stepped { mut transition, changed_tiles, simulator_us, .. } => {
                if let Some(tiles) = changed_tiles {
                    let last = mem::take(&mut self.observation.image);
                    let image = &mut transition.observation.image;
                    image.complete(&tiles, last).map_err(EnvironmentFault::wire)?;
                }
                self.simulator_time = Duration::from_micros(simulator_us.into());
                self.observe(transition.observation.clone())?;
                Ok(transition)
            }
            other => Err(unexpected("Stepped", &other)),
        }
    }

    /// The simulator's time for the last step according to its server. The rest of the waiting time
    /// is transport.
    pub fn simulator_time(&self) -> Duration {
        self.simulator_time
    }

    /// Size of the last reply, which may contain only the changed tiles of its image.
    pub fn reply_bytes(&self) -> usize {
        self.environment.reply_bytes
    }

    /// Requests the last reply again. Nothing is simulated or encoded for it.
    pub async fn repeat(&mut self) -> Result<(), EnvironmentFault> {
        self.environment.ask_again("a repeated request").await.map(drop)
    }

    /// Saves the current state in `slot` until the end of the episode.
    pub async fn save(&mut self, slot: u32) -> Result<(), EnvironmentFault> {
        match self.environment.ask("Save", |sequence| Request::Save { sequence, slot }).await? {
            Reply::Saved { .. } => Ok(()),
            other => Err(unexpected("Saved", &other)),
        }
    }

    /// Restores the state in `slot`, bit by bit.
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

    /// Ends the episode and returns the session for another one.
    pub fn finish(self) -> Environment {
        self.environment
    }

    fn observe(&mut self, observation: Observation) -> Result<(), EnvironmentFault> {
        self.environment.check_image(&observation.image)?;
        self.observation = observation;
        Ok(())
    }
}

impl session::Episode for Episode {
    type Environment = Environment;

    fn observation(&self) -> &Observation {
        Episode::observation(self)
    }

    async fn step(&mut self, action: &[f32]) -> Result<Transition, EnvironmentFault> {
        Episode::step(self, action).await
    }

    fn simulator_time(&self) -> Duration {
        Episode::simulator_time(self)
    }

    fn finish(self) -> Environment {
        Episode::finish(self)
    }
}
