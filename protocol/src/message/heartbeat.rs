//! The sign that a server's simulation moves, which its liveliness token cannot give.

use serde::{Deserialize, Serialize};

use super::value;
use crate::codec::Message;
use crate::limits::{HEARTBEAT_BYTES_MAX, SESSIONS_MAX};

/// Sent by the thread that steps the worlds, about twice a second.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Heartbeat {
    /// The server's id.
    pub server: String,
    /// Sessions in use.
    pub sessions: u32,
    /// Control steps since the server's start.
    pub steps: u64,
    /// Memory that the process holds.
    pub resident_bytes: u64,
}

impl Message for Heartbeat {
    const NAME: &'static str = "heartbeat";
    const BYTES_MAX: usize = HEARTBEAT_BYTES_MAX;

    fn validate(&self) -> Result<(), String> {
        value::name("server", &self.server)?;
        value::range("sessions", self.sessions.into(), 0, SESSIONS_MAX.into())
    }
}
