//! A connection to a vla-eval model server.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result, bail, ensure};
use decision::EpisodeName;

use super::connection::Reply;
use super::socket::{CONNECT_WAIT, Frame, Socket};
use crate::Address;
use crate::codec::extension::Answer;
use crate::codec::vla_eval::{self, Kind, Message};
use crate::codec::{Value, encode};

/// A connection to a model server, which keeps its state by connection and episode.
pub struct VlaEval {
    socket: Socket,
    /// The number of the last message.
    sequence: u64,
    /// Observations since the start of the episode.
    steps: u64,
    started: SystemTime,
}

impl VlaEval {
    /// Connects, says hello and returns the payload of the server's hello.
    pub async fn connect(address: &Address, key: Option<&str>) -> Result<(VlaEval, Vec<u8>)> {
        let socket = Socket::connect(address, key).await?;
        let mut connection = VlaEval { socket, sequence: 0, steps: 0, started: SystemTime::now() };
        let hello = Value::map([
            ("harness_version", Value::text(concat!("rever ", env!("CARGO_PKG_VERSION")))),
            ("protocol_version", Value::Integer(vla_eval::PROTOCOL_VERSION)),
        ]);
        let frame = connection.exchange(Kind::Hello, hello, CONNECT_WAIT).await;
        let frame = frame.context("expected a vla-eval server's hello")?;
        let reply = connection.check(&frame, Kind::Hello)?;
        vla_eval::check_hello(&reply.payload)?;
        Ok((connection, encode(&reply.payload)?))
    }

    /// Begins an episode: the server forgets the last one.
    pub async fn begin(&mut self, name: &EpisodeName) -> Result<()> {
        (self.steps, self.started) = (0, SystemTime::now());
        let task = Value::map([
            ("name", Value::text(&name.task)),
            ("suite", Value::text("rever")),
            ("episode_idx", Value::Integer(name.episode.into())),
        ]);
        self.tell(Kind::EpisodeStart, Value::map([("task", task)])).await
    }

    /// Sends an observation and waits for its actions.
    pub async fn ask(&mut self, observation: Value<'_>, wait: Duration) -> Result<Reply> {
        self.steps += 1;
        let frame = self.exchange(Kind::Observation, observation, wait).await?;
        let reply = self.check(&frame, Kind::Action)?;
        let actions = vla_eval::actions_of(&reply.payload)?;
        Ok(Reply { actions, answer: Answer::read(&reply.payload)? })
    }

    /// Ends the episode.
    pub async fn end(&mut self) -> Result<()> {
        let elapsed = self.started.elapsed().unwrap_or_default().as_secs_f64();
        let payload = Value::map([
            ("metrics", Value::map([])),
            ("steps", Value::Integer(self.steps.into())),
            ("elapsed_sec", Value::Float(elapsed)),
        ]);
        self.tell(Kind::EpisodeEnd, payload).await
    }

    async fn tell(&mut self, kind: Kind, payload: Value<'_>) -> Result<()> {
        let frame = self.frame(kind, payload)?;
        self.socket.tell(frame).await
    }

    async fn exchange(
        &mut self,
        kind: Kind,
        payload: Value<'_>,
        wait: Duration,
    ) -> Result<Vec<u8>> {
        let frame = self.frame(kind, payload)?;
        match self.socket.ask(Some(frame), wait).await?.frame {
            Frame::Binary(bytes) => Ok(bytes.to_vec()),
            Frame::Text(_) => bail!("expected a binary frame, got a text frame"),
        }
    }

    fn frame(&mut self, kind: Kind, payload: Value<'_>) -> Result<Vec<u8>> {
        self.sequence += 1;
        let timestamp = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let timestamp = timestamp.as_secs_f64();
        Message { kind, payload, sequence: self.sequence, timestamp }.encode()
    }

    /// Checks that a frame answers the last message. An error may also be about the start of the
    /// episode, which has no answer otherwise.
    fn check<'a>(&self, frame: &'a [u8], expected: Kind) -> Result<Message<'a>> {
        let message = Message::decode(frame)?;
        if message.kind == Kind::Error {
            bail!("the server failed: {}", vla_eval::error_of(&message.payload));
        }
        ensure!(
            message.kind == expected,
            "expected a message {}, got {}",
            expected.name(),
            message.kind.name()
        );
        ensure!(
            message.sequence == self.sequence,
            "expected the answer to message {}, got the answer to message {}",
            self.sequence,
            message.sequence
        );
        Ok(message)
    }
}
