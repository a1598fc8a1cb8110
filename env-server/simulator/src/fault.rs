//! What can go wrong in the world: each fault is its own and never a reward.

use protocol::FaultKind;
use thiserror::Error;

/// Why the world did not do what was asked; the words are those of the Python server.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Fault {
    /// The request is wrong at this moment, and the world is unchanged.
    #[error("{0}")]
    Wrong(String),
    /// Positions or velocities became non-finite or impossibly large.
    #[error("{0}")]
    PhysicsDiverged(String),
    /// No OpenGL context could be made.
    #[error("{0}")]
    RendererUnavailable(String),
    /// A scene or the description of the tasks is not what this program reads.
    #[error("{0}")]
    Internal(String),
}

impl Fault {
    /// How the protocol calls it; none when it is a refusal and no fault of the world.
    pub fn kind(&self) -> Option<FaultKind> {
        match self {
            Fault::Wrong(_) => None,
            Fault::PhysicsDiverged(_) => Some(FaultKind::PhysicsDiverged),
            Fault::RendererUnavailable(_) => Some(FaultKind::RendererUnavailable),
            Fault::Internal(_) => Some(FaultKind::Internal),
        }
    }
}
