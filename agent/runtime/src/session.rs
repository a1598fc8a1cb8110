//! The seam for environments: sessions of servers over zenoh, or of a script.
//!
//! The types forbid a wrong order: only what [`Environment::reset`] returns can step, and only [`Episode::finish`] gives
//! the session back. After a fault the session is gone with the episode.

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

    /// Starts an episode. A fault gives the session up.
    fn reset(
        self,
        reset: Reset,
    ) -> impl Future<Output = Result<Self::Episode, EnvironmentFault>> + Send;
}

/// A running episode.
pub trait Episode: Send + Sized + 'static {
    /// The session that it owns.
    type Environment;

    /// What the policy sees now.
    fn observation(&self) -> &Observation;

    /// One control step. After a fault the episode is void.
    fn step(
        &mut self,
        action: &[f32],
    ) -> impl Future<Output = Result<Transition, EnvironmentFault>> + Send;

    /// The server's time for the last step: physics, image and statistics. The rest of the wait was the wire.
    fn simulator_time(&self) -> Duration;

    /// Ends the episode; the session can start another one.
    fn finish(self) -> Self::Environment;
}

/// What a session must offer.
#[derive(Debug, Clone, PartialEq)]
pub struct SessionRequest {
    /// The task that will be reset.
    pub task: TaskId,
    /// Whether observations must carry the scripted expert's action.
    pub needs_expert: bool,
}

/// Where a session is.
#[derive(Debug, Clone, PartialEq)]
pub struct SessionInfo {
    /// The server's id.
    pub server: String,
    /// The server's simulator and its version.
    pub simulator: String,
    /// The task that was asked for, as the server describes it.
    pub task: TaskDescription,
}

/// A session in use.
#[derive(Debug)]
pub struct Session<E> {
    /// Where it is.
    pub info: SessionInfo,
    /// What is reset.
    pub environment: E,
}

/// Opens sessions and keeps those that are idle.
pub trait SessionPool: Send + Sync + 'static {
    /// What it opens.
    type Environment: Environment;

    /// Waits for a session. An error means that the run cannot go on: no server can give one.
    fn acquire(
        &self,
        request: &SessionRequest,
    ) -> impl Future<Output = Result<Session<Self::Environment>>> + Send;

    /// Takes back the session of an episode that ended well.
    fn release(&self, session: Session<Self::Environment>);

    /// Takes note that a session is gone, and that its server may be.
    fn lost(&self, info: &SessionInfo, fault: &EnvironmentFault);
}
