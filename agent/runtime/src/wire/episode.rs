//! A running episode: only what a reset returned can step.

use std::mem;
use std::time::Duration;

use protocol::{Observation, Reply, Request, Transition};

use super::Environment;
use super::environment::unexpected;
use crate::fault::EnvironmentFault;
use crate::session;

/// Owns its environment until [`Episode::finish`]. After any fault but `Refused` it is void: drop it.
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

    /// What the policy sees now.
    pub fn observation(&self) -> &Observation {
        &self.observation
    }

    /// The server's id.
    pub fn server(&self) -> &str {
        self.environment.server()
    }

    /// One control step.
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

    /// What the last step took in the simulator, as its server says: the rest of the wait for it was the wire.
    pub fn simulator_time(&self) -> Duration {
        self.simulator_time
    }

    /// Size of the last reply, whose image may be the tiles that changed.
    pub fn reply_bytes(&self) -> usize {
        self.environment.reply_bytes
    }

    /// Has the last reply sent once more; the world does not move, and nothing is written anew.
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
