//! Faults of the environment. A fault is never a reward.

use protocol::FaultKind;
use thiserror::Error;

/// Why a request failed. The texts are those of the Python server.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum Fault {
    /// The request is invalid now; the environment is unchanged.
    #[error("{0}")]
    Wrong(String),
    /// Positions or velocities became non-finite or impossibly large.
    #[error("{0}")]
    PhysicsDiverged(String),
    /// No OpenGL context could be created.
    #[error("{0}")]
    RendererUnavailable(String),
    /// A scene or the description of the tasks is invalid.
    #[error("{0}")]
    Internal(String),
}

impl Fault {
    /// The kind in the protocol; `None` for a refused request.
    pub fn kind(&self) -> Option<FaultKind> {
        match self {
            Fault::Wrong(_) => None,
            Fault::PhysicsDiverged(_) => Some(FaultKind::PhysicsDiverged),
            Fault::RendererUnavailable(_) => Some(FaultKind::RendererUnavailable),
            Fault::Internal(_) => Some(FaultKind::Internal),
        }
    }
}
