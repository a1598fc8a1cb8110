//! Leasing a session.

use serde::{Deserialize, Serialize};

use super::value;
use crate::codec::Message;
use crate::limits::{OPEN_BYTES_MAX, OPENING_BYTES_MAX};

/// The payload of a query on `open`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Open {
    /// Version of the protocol that the agent speaks; another one is refused.
    pub protocol: u32,
    /// The task that comes first, so that the server can prepare it; every `Reset` names its own.
    pub task: String,
    /// Its variant.
    pub variant: String,
    /// Rows of every image in this session; with 0 x 0, observations come without one.
    pub image_height: u32,
    /// Columns of every image in this session.
    pub image_width: u32,
    /// Whether observations carry the scripted expert's action: for evaluation only.
    pub expert: bool,
    /// Who asks, for the server's log.
    pub holder: String,
}

/// The answer to it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub enum Opening {
    /// The session is the asker's for as long as its liveliness token stands.
    Opened {
        /// The session's id, as in its keys.
        session: String,
    },
    /// There is no session for the asker.
    Refused {
        /// What was expected and what came.
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
