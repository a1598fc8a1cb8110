//! One WebSocket: finds out which wire the client speaks, and answers its frames one after the other.
//!
//! vla-eval's client speaks first, openpi's client waits for the server. So the server waits a moment
//! for a first frame. If none comes, it sends a frame that is both openpi's metadata and vla-eval's
//! hello: a map with the keys of both. The first frame of the client then tells which wire it is, so
//! that a slow network changes nothing.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Result;
use batching::Active;
use futures_util::{SinkExt, StreamExt};
use hyper::upgrade::Upgraded;
use hyper_util::rt::TokioIo;
use tokio::sync::watch;
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Bytes, Error, Message};

use super::agent::ServedAgent;
use super::openpi::{self, OpenpiClient};
use super::session::Session;
use super::vla_eval::{self, Outcome, VlaEvalClient};
use crate::codec::{Value, decode, encode};

/// How long the server waits for a client that speaks first.
const HELLO_WAIT: Duration = Duration::from_millis(100);
/// A client that takes longer to receive a reply is gone.
const SEND_WAIT: Duration = Duration::from_secs(30);
/// How long a closed connection waits for the client's own close.
const CLOSE_WAIT: Duration = Duration::from_secs(1);
/// A batch waits for a client until this long after its last reply.
const ACTIVE_WAIT: Duration = Duration::from_secs(1);
/// Maximum length of the reason in a close frame, which is a limit of WebSocket.
const REASON_BYTES_MAX: usize = 123;

pub(super) type Socket = WebSocketStream<TokioIo<Upgraded>>;

/// Serves one client until it leaves or the server stops.
pub(super) async fn serve(
    socket: Socket,
    agent: Arc<ServedAgent>,
    mut stop: watch::Receiver<bool>,
) {
    let mut connection = Connection { socket, agent, activity: None, has_greeted: false };
    let ended = tokio::select! {
        ended = connection.run() => ended,
        _ = stop.wait_for(|stop| *stop) => Err((CloseCode::Away, "the server stops".to_owned())),
    };
    if let Err((code, reason)) = ended {
        connection.close(code, &reason).await;
    }
}

struct Connection {
    socket: Socket,
    agent: Arc<ServedAgent>,
    /// Held while this client is active: batches wait for it.
    activity: Option<Active>,
    /// Whether the frame that is metadata and hello was sent.
    has_greeted: bool,
}

enum Wire {
    Openpi(OpenpiClient),
    VlaEval(VlaEvalClient),
}

/// Why the server closes a connection.
type Closing = (CloseCode, String);

impl Connection {
    /// Ends without a reason when the client has left.
    async fn run(&mut self) -> Result<(), Closing> {
        let first = match timeout(HELLO_WAIT, self.receive()).await {
            Ok(first) => first?,
            Err(_) => {
                self.greet().await?;
                self.receive().await?
            }
        };
        let Some(mut frame) = first else { return Ok(()) };
        let session = Session::new(Arc::clone(&self.agent));
        let mut wire = match decode(&frame) {
            Ok(value) if vla_eval::is_message(&value) => Wire::VlaEval(VlaEvalClient::new(session)),
            _ => Wire::Openpi(OpenpiClient::new(session)),
        };
        if let (Wire::Openpi(_), false) = (&wire, self.has_greeted) {
            self.greet().await?;
        }
        loop {
            self.activity.get_or_insert_with(|| self.agent.batcher.activate());
            self.answer(&mut wire, &frame).await?;
            let Some(next) = self.next_frame().await? else { return Ok(()) };
            frame = next;
        }
    }

    async fn answer(&mut self, wire: &mut Wire, frame: &[u8]) -> Result<(), Closing> {
        match wire {
            Wire::Openpi(client) => match client.answer(frame).await {
                Ok(reply) => self.send(Message::binary(reply)).await,
                Err(error) => {
                    let reason = format!("{error:#}");
                    tracing::warn!("openpi client: {reason}");
                    self.send(Message::text(reason.clone())).await?;
                    Err((CloseCode::Error, reason))
                }
            },
            Wire::VlaEval(client) => {
                let outcome = client.answer(frame, self.has_greeted).await.map_err(internal)?;
                // Only the first hello may come after the server's.
                self.has_greeted = false;
                match outcome {
                    Outcome::Silence => Ok(()),
                    Outcome::Reply(reply) => self.send(Message::binary(reply)).await,
                    Outcome::Refuse(reply, reason) => {
                        tracing::warn!("vla-eval client: {reason}");
                        self.send(Message::binary(reply)).await?;
                        Err((CloseCode::Invalid, reason))
                    }
                }
            }
        }
    }

    /// Sends what is both openpi's metadata and vla-eval's hello.
    async fn greet(&mut self) -> Result<(), Closing> {
        let mut fields = openpi::metadata(&self.agent).map_err(internal)?;
        fields.extend([
            ("type", Value::Text(Cow::Borrowed("hello"))),
            ("payload", vla_eval::hello_payload(&self.agent).map_err(internal)?),
            ("seq", Value::Integer(1)),
            ("timestamp", Value::Float(vla_eval::now())),
        ]);
        let frame = encode(&Value::map(fields)).map_err(internal)?;
        self.send(Message::binary(frame)).await?;
        self.has_greeted = true;
        Ok(())
    }

    /// The next frame, during which batches stop waiting for this client after a while.
    async fn next_frame(&mut self) -> Result<Option<Bytes>, Closing> {
        if let Ok(frame) = timeout(ACTIVE_WAIT, self.receive()).await {
            return frame;
        }
        self.activity = None;
        self.receive().await
    }

    /// The next frame; none when the client has left. Dropping the future loses nothing.
    async fn receive(&mut self) -> Result<Option<Bytes>, Closing> {
        loop {
            match self.socket.next().await {
                Some(Ok(Message::Binary(bytes))) => return Ok(Some(bytes)),
                Some(Ok(Message::Text(_))) => {
                    let reason = "expected a binary frame, got text".to_owned();
                    return Err((CloseCode::Unsupported, reason));
                }
                Some(Ok(Message::Close(_))) | None => return Ok(None),
                Some(Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_))) => {}
                Some(Err(Error::Capacity(error))) => {
                    return Err((CloseCode::Size, error.to_string()));
                }
                Some(Err(Error::Protocol(error))) => {
                    return Err((CloseCode::Protocol, error.to_string()));
                }
                // The connection is gone.
                Some(Err(_)) => return Ok(None),
            }
        }
    }

    async fn send(&mut self, message: Message) -> Result<(), Closing> {
        match timeout(SEND_WAIT, self.socket.send(message)).await {
            Ok(Ok(())) => Ok(()),
            Ok(Err(error)) => Err((CloseCode::Away, error.to_string())),
            Err(_) => Err((CloseCode::Away, "the reply was not received in time".to_owned())),
        }
    }

    /// Closes with a reason and waits a moment for the client to have read it.
    async fn close(&mut self, code: CloseCode, reason: &str) {
        let mut end = reason.len().min(REASON_BYTES_MAX);
        while !reason.is_char_boundary(end) {
            end -= 1;
        }
        let frame = CloseFrame { code, reason: reason[..end].into() };
        let close = async {
            // The client may be gone.
            let _ = self.socket.send(Message::Close(Some(frame))).await;
            while let Some(Ok(_)) = self.socket.next().await {}
        };
        let _ = timeout(CLOSE_WAIT, close).await;
    }
}

fn internal(error: anyhow::Error) -> Closing {
    (CloseCode::Error, format!("{error:#}"))
}
