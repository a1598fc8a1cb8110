//! Leasing a session.

use serde::{Deserialize, Serialize};

use super::value;
use crate::codec::Message;
use crate::limits::{OPEN_BYTES_MAX, OPENING_BYTES_MAX};

/// The payload of a query on `open`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Open {
    /// Version of the protocol that the agent uses; any other version is refused.
    pub protocol: u32,
    /// The first task, so that the server can prepare it. Every `Reset` names its own task.
    pub task: String,
    /// Its variant.
    pub variant: String,
    /// Height of every image in this session. With 0 x 0, observations have no image.
    pub image_height: u32,
    /// Width of every image in this session.
    pub image_width: u32,
    /// Whether observations include the scripted expert's action; for evaluation only.
    pub expert: bool,
    /// Name of the agent, for the server's log.
    pub holder: String,
}

/// The reply to [`Open`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub enum Opening {
    /// The session belongs to the agent as long as the agent's liveliness token exists.
    Opened {
        /// The session's id, as in its keys.
        session: String,
    },
    /// The agent gets no session.
    Refused {
        /// What was expected and what was received.
        reason: String,
    },
}

impl Message for Open {
    const NAME: &'static str = "open";
    const BYTES_MAX: usize = OPEN_BYTES_MAX;

    fn recognise(bytes: &[u8]) -> Result<(), String> {
        value::recognise_protocol(bytes)
    }

    fn validate(&self) -> Result<(), String> {
        value::protocol(self.protocol)?;
        value::name("task", &self.task)?;
        value::name("variant", &self.variant)?;
        let fields = ["image_height", "image_width"];
        value::image_sides(fields, self.image_height.into(), self.image_width.into())?;
        value::name("holder", &self.holder)
    }
}

impl Message for Opening {
    const NAME: &'static str = "opening";
    const BYTES_MAX: usize = OPENING_BYTES_MAX;

    fn validate(&self) -> Result<(), String> {
        match self {
            Opening::Opened { session } => value::name("session", session),
            Opening::Refused { reason } => value::text("reason", reason),
        }
    }
}
