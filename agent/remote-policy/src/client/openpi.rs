//! A connection to an openpi server.

use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};

use super::connection::Reply;
use super::socket::{CONNECT_WAIT, Frame, Socket};
use crate::Address;
use crate::codec::extension::Answer;
use crate::codec::{Value, encode, openpi, printable};

/// A server that also speaks vla-eval sends its hello as metadata, with the time of sending.
const TIMESTAMP: &str = "timestamp";

/// A connection to an openpi server, which keeps no state between observations.
pub struct OpenPi {
    socket: Socket,
}

impl OpenPi {
    /// Connects and returns the server's metadata.
    pub async fn connect(address: &Address, key: Option<&str>) -> Result<(OpenPi, Vec<u8>)> {
        let socket = Socket::connect(address, key).await?;
        let metadata = socket.ask(None, CONNECT_WAIT).await;
        let metadata =
            metadata.context("expected an openpi server's metadata as its first frame")?;
        let metadata = lasting(&binary(metadata.frame)?)?;
        Ok((OpenPi { socket }, metadata))
    }

    /// Sends an observation and waits for its actions.
    pub async fn ask(&self, observation: &Value<'_>, wait: Duration) -> Result<Reply> {
        let answered = self.socket.ask(Some(encode(observation)?), wait).await?;
        ensure!(!answered.is_early, "the server sent a frame that nothing asked for");
        let frame = binary(answered.frame)?;
        let result = openpi::map(&frame)?;
        Ok(Reply { actions: openpi::actions_of(&result)?, answer: Answer::read(&result)? })
    }
}

/// The metadata without the time at which it was sent: the rest must not change during a run.
fn lasting(frame: &[u8]) -> Result<Vec<u8>> {
    let Value::Map(mut entries) = openpi::map(frame)? else { bail!("expected a map") };
    entries.retain(|(key, _)| key.name != TIMESTAMP);
    encode(&Value::Map(entries))
}

/// A text frame is the server's error.
fn binary(frame: Frame) -> Result<Vec<u8>> {
    match frame {
        Frame::Binary(bytes) => Ok(bytes.to_vec()),
        Frame::Text(text) => bail!("the server failed: {}", printable(&openpi::error_of(&text))),
    }
}
