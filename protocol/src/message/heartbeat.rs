//! Proof that a server's simulation is making progress; its liveliness token shows only that the
//! process exists.

use serde::{Deserialize, Serialize};

use super::value;
use crate::codec::Message;
use crate::limits::{HEARTBEAT_BYTES_MAX, SESSIONS_MAX};

/// Sent about twice a second by the thread that steps the environments.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Heartbeat {
    /// The server's id.
    pub server: String,
    /// Sessions in use.
    pub sessions: u32,
    /// Control steps since the server started.
    pub steps: u64,
    /// Resident memory of the process.
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
