//! vla-eval's WebSocket messages: a kind, a payload, a number that the reply repeats, and a time.
//! Arrays have keys of text.

use std::borrow::Cow;

use anyhow::{Context, Result, bail, ensure};

use super::{KeyForm, Value, actions, decode, encode, printable};

/// The version that this project speaks.
pub const PROTOCOL_VERSION: i128 = 1;
/// The encoding of an array's keys.
pub const KEYS: KeyForm = KeyForm::Text;

/// What a message is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// First in both directions.
    Hello,
    /// From the client: an observation that waits for an action.
    Observation,
    /// From the server: the answer to an observation.
    Action,
    /// From the client, without an answer.
    EpisodeStart,
    /// From the client, without an answer.
    EpisodeEnd,
    /// From the server: a request failed; the connection stays.
    Error,
}

impl Kind {
    const ALL: [(Kind, &'static str); 6] = [
        (Kind::Hello, "hello"),
        (Kind::Observation, "observation"),
        (Kind::Action, "action"),
        (Kind::EpisodeStart, "episode_start"),
        (Kind::EpisodeEnd, "episode_end"),
        (Kind::Error, "error"),
    ];

    /// The name on the wire.
    pub fn name(self) -> &'static str {
        Kind::ALL.iter().find(|(kind, _)| *kind == self).map_or("", |(_, name)| name)
    }
}

/// One message.
#[derive(Debug, Clone, PartialEq)]
pub struct Message<'a> {
    /// What it is.
    pub kind: Kind,
    /// A map.
    pub payload: Value<'a>,
    /// A client counts its messages from 1; a reply has the number of its request.
    pub sequence: u64,
    /// Seconds since 1970.
    pub timestamp: f64,
}

impl<'a> Message<'a> {
    /// Decodes a message.
    pub fn decode(frame: &'a [u8]) -> Result<Message<'a>> {
        Message::read(frame).context("vla-eval message")
    }

    fn read(frame: &'a [u8]) -> Result<Message<'a>> {
        let Value::Map(entries) = decode(frame)? else { bail!("expected a map") };
        let (mut kind, mut payload, mut sequence, mut timestamp) = (None, None, None, None);
        for (key, value) in entries {
            match &*key.name {
                "type" => kind = Some(kind_of(value.as_text().context("type")?)?),
                "payload" => payload = Some(value),
                "seq" => sequence = Some(value.as_integer().context("seq")?),
                "timestamp" => timestamp = Some(value.as_number().context("timestamp")?),
                // A later minor version may add fields.
                _ => {}
            }
        }
        let payload = payload.context("expected the key \"payload\"")?;
        payload.entries().context("payload")?;
        Ok(Message {
            kind: kind.context("expected the key \"type\"")?,
            payload,
            sequence: sequence.context("expected the key \"seq\"")?,
            timestamp: timestamp.context("expected the key \"timestamp\"")?,
        })
    }

    /// Encodes this message.
    pub fn encode(self) -> Result<Vec<u8>> {
        encode(&Value::map([
            ("type", Value::Text(Cow::Borrowed(self.kind.name()))),
            ("payload", self.payload),
            ("seq", Value::Integer(self.sequence.into())),
            ("timestamp", Value::Float(self.timestamp)),
        ]))
    }
}

fn kind_of(name: &str) -> Result<Kind> {
    match Kind::ALL.iter().find(|(_, known)| *known == name) {
        Some((kind, _)) => Ok(*kind),
        None => {
            let known: Vec<&str> = Kind::ALL.iter().map(|(_, name)| *name).collect();
            bail!("type: expected one of {}, got {:?}", known.join(", "), printable(name))
        }
    }
}

/// Checks the protocol's version in a peer's hello.
pub fn check_hello(payload: &Value<'_>) -> Result<()> {
    let version: i128 =
        payload.field("protocol_version")?.as_integer().context("protocol_version")?;
    ensure!(
        version == PROTOCOL_VERSION,
        "vla-eval: expected protocol version {PROTOCOL_VERSION}, got {version}"
    );
    Ok(())
}

/// The actions of an action message's payload.
pub fn actions_of(payload: &Value<'_>) -> Result<Vec<Vec<f32>>> {
    actions::actions(payload.field("actions").context("vla-eval action")?)
}

/// What an error message says.
pub fn error_of(payload: &Value<'_>) -> String {
    let reason = payload.get("error").and_then(|error| error.as_text().ok());
    printable(reason.unwrap_or("no reason"))
}
