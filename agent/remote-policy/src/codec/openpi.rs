//! openpi's WebSocket frames: the server's metadata, then observation and result in turn. Every
//! frame is a map; arrays have keys of bytes. A text frame is the server's error.

use anyhow::{Context, Result};

use super::{KeyForm, Value, actions, decode, printable};

/// The encoding of an array's keys.
pub const KEYS: KeyForm = KeyForm::Bytes;
/// Header of a request for a connection.
pub const AUTHORIZATION: &str = "Authorization";

/// The header's value for a key.
pub fn authorization(key: &str) -> String {
    format!("Api-Key {key}")
}

/// Decodes the metadata, an observation or a result.
pub fn map(frame: &[u8]) -> Result<Value<'_>> {
    let value = decode(frame)?;
    value.entries().context("openpi frame")?;
    Ok(value)
}

/// The actions of a result.
pub fn actions_of(result: &Value<'_>) -> Result<Vec<Vec<f32>>> {
    actions::actions(result.field("actions").context("openpi result")?)
}

/// What a server's text frame says: the last line of a Python traceback.
pub fn error_of(text: &str) -> String {
    let last = text.lines().rev().find(|line| !line.trim().is_empty());
    printable(last.unwrap_or("no reason"))
}
