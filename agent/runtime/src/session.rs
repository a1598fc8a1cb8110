//! The interface of environments: sessions of servers over zenoh, or scripted ones.
//!
//! The types prevent a wrong order: only the result of [`Environment::reset`] can step, and only
//! [`Episode::finish`] returns the session. After a fault the session is lost together with the
//! episode.

use std::future::Future;
use std::time::Duration;

use anyhow::Result;
use decision::TaskId;
use protocol::{Observation, Reset, TaskDescription, Transition};

use crate::fault::EnvironmentFault;

/// A session between episodes.
pub trait Environment: Send + Sized + 'static {
    /// A running episode of this session.
    type Episode: Episode<Environment = Self>;

    /// Starts an episode. After a fault the session is lost.
    fn reset(
        self,
        reset: Reset,
    ) -> impl Future<Output = Result<Self::Episode, EnvironmentFault>> + Send;
}

/// A running episode.
pub trait Episode: Send + Sized + 'static {
    /// The session of the episode.
    type Environment;

    /// The current observation.
    fn observation(&self) -> &Observation;

    /// Executes one control step. After a fault the episode is void.
    fn step(
        &mut self,
        action: &[f32],
    ) -> impl Future<Output = Result<Transition, EnvironmentFault>> + Send;

    /// The server's time for the last step: physics, image and statistics. The rest of the waiting
    /// time is transport.
    fn simulator_time(&self) -> Duration;

    /// Ends the episode and returns the session for another one.
    fn finish(self) -> Self::Environment;
}

/// The requirements for a session.
#[derive(Debug, Clone, PartialEq)]
pub struct SessionRequest {
    /// The task to reset.
    pub task: TaskId,
    /// Whether observations must include the scripted expert's action.
    pub needs_expert: bool,
}

/// The server of a session.
#[derive(Debug, Clone, PartialEq)]
pub struct SessionInfo {
    /// The server's id.
    pub server: String,
    /// The server's simulator and its version.
    pub simulator: String,
    /// The requested task as described by the server.
    pub task: TaskDescription,
}

/// A session in use.
#[derive(Debug)]
pub struct Session<E> {
    /// The server of the session.
    pub info: SessionInfo,
    /// The environment to reset.
    pub environment: E,
}

/// Opens sessions and keeps idle ones.
pub trait SessionPool: Send + Sync + 'static {
    /// The environments of the pool.
    type Environment: Environment;

    /// Waits for a session. An error ends the run: no server can provide one.
    fn acquire(
        &self,
        request: &SessionRequest,
    ) -> impl Future<Output = Result<Session<Self::Environment>>> + Send;

    /// Returns the session of an episode that ended without a fault.
    fn release(&self, session: Session<Self::Environment>);

    /// Reports that a session was lost, and its server possibly too.
    fn lost(&self, info: &SessionInfo, fault: &EnvironmentFault);
}
