//! A WebSocket with limits. Its own task reads all the time, so that a server's pings are answered
//! while an episode steps.

use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail};
use futures_util::{SinkExt, StreamExt};
use tokio::net::TcpStream;
use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::error::{Error as SocketError, ProtocolError};
use tokio_tungstenite::tungstenite::protocol::WebSocketConfig;
use tokio_tungstenite::tungstenite::{Bytes, Message, http};
use tokio_tungstenite::{WebSocketStream, client_async_with_config};

use crate::Address;
use crate::codec::{FRAME_BYTES_MAX, openpi, printable};

/// Maximum wait for a TCP connection and its handshake.
pub const CONNECT_WAIT: Duration = Duration::from_secs(10);
/// Maximum wait for a frame to be taken by the network.
const SEND_WAIT: Duration = Duration::from_secs(30);
/// Maximum number of requests that wait for the socket; a connection has one at a time.
const WAITING_MAX: usize = 4;

/// What a server sent.
#[derive(Debug)]
pub enum Frame {
    /// A binary frame.
    Binary(Bytes),
    /// A text frame.
    Text(String),
}

/// The answer to a question.
#[derive(Debug)]
pub struct Answered {
    /// What came.
    pub frame: Frame,
    /// Whether it came before the question was sent.
    pub is_early: bool,
}

/// A connection. Dropping it closes it.
pub struct Socket {
    commands: mpsc::Sender<Command>,
}

/// A frame to send, and who waits for the answer.
struct Command {
    frame: Option<Vec<u8>>,
    answer: Option<oneshot::Sender<Result<Answered>>>,
}

impl Socket {
    /// Connects. A key is sent as `Authorization: Api-Key`.
    pub async fn connect(address: &Address, key: Option<&str>) -> Result<Socket> {
        let stream = timeout(CONNECT_WAIT, open(address, key)).await;
        let stream =
            stream.map_err(|_| anyhow!("no answer within {} s", CONNECT_WAIT.as_secs()))??;
        let (commands, received) = mpsc::channel(WAITING_MAX);
        tokio::spawn(serve(stream, received));
        Ok(Socket { commands })
    }

    /// Sends a frame and waits for the next one. Without a frame it only waits.
    pub async fn ask(&self, frame: Option<Vec<u8>>, wait: Duration) -> Result<Answered> {
        let (answer, answered) = oneshot::channel();
        let command = Command { frame, answer: Some(answer) };
        let lost = || anyhow!("the server closed the connection");
        self.commands.send(command).await.map_err(|_| lost())?;
        match timeout(wait, answered).await {
            Ok(answer) => answer.map_err(|_| lost())?,
            Err(_) => bail!("no answer within {} s", wait.as_secs()),
        }
    }

    /// Sends a frame that has no answer.
    pub async fn tell(&self, frame: Vec<u8>) -> Result<()> {
        let command = Command { frame: Some(frame), answer: None };
        self.commands.send(command).await.map_err(|_| anyhow!("the server closed the connection"))
    }
}

async fn open(address: &Address, key: Option<&str>) -> Result<WebSocketStream<TcpStream>> {
    let authority = address.authority();
    let stream = TcpStream::connect(&*authority).await.context("cannot connect")?;
    stream.set_nodelay(true).context("cannot set TCP_NODELAY")?;
    let mut request = format!("ws://{authority}{}", address.path).into_client_request()?;
    if let Some(key) = key {
        let value = openpi::authorization(key).parse().context("key: expected printable ASCII")?;
        request.headers_mut().insert(openpi::AUTHORIZATION, value);
    }
    let limits = WebSocketConfig::default()
        .max_message_size(Some(FRAME_BYTES_MAX))
        .max_frame_size(Some(FRAME_BYTES_MAX));
    match client_async_with_config(request, stream, Some(limits)).await {
        Ok((stream, _)) => Ok(stream),
        // An `io::Error`, so that the start of an episode waits for a free place.
        Err(SocketError::Http(response))
            if response.status() == http::StatusCode::SERVICE_UNAVAILABLE =>
        {
            let kind = std::io::ErrorKind::ResourceBusy;
            Err(std::io::Error::new(kind, "the server has no free place (503)").into())
        }
        Err(SocketError::Http(response)) => bail!("{}", refusal(response.status(), key.is_some())),
        Err(error) => bail!("no WebSocket server: {}", printable(&error.to_string())),
    }
}

/// Why a server refused the handshake.
fn refusal(status: http::StatusCode, has_key: bool) -> String {
    match status.as_u16() {
        401 | 403 if has_key => format!("the server refused the key ({status})"),
        401 | 403 => format!("the server wants a key ({status}); see --policy-key-file"),
        _ => format!("expected a WebSocket, got {status}"),
    }
}

/// Answers commands one after the other. Keeps one thing that came without a question: a frame, or
/// the reason why the connection ended.
async fn serve(mut stream: WebSocketStream<TcpStream>, mut commands: mpsc::Receiver<Command>) {
    let mut early: Option<Result<Frame>> = None;
    loop {
        tokio::select! {
            command = commands.recv() => {
                let Some(command) = command else { break };
                if !obey(&mut stream, command, &mut early).await {
                    break;
                }
            }
            frame = next(&mut stream), if early.is_none() => early = Some(frame),
        }
    }
    let _ = timeout(CONNECT_WAIT, stream.close(None)).await;
}

/// Sends a frame and passes on its answer. Returns whether the connection is still usable: not
/// after an error, and not if nobody waits for the answer any more.
async fn obey(
    stream: &mut WebSocketStream<TcpStream>,
    command: Command,
    early: &mut Option<Result<Frame>>,
) -> bool {
    let Command { frame, answer } = command;
    let sent = match frame {
        Some(frame) => send(stream, frame).await,
        None => Ok(()),
    };
    let Some(mut answer) = answer else { return sent.is_ok() };
    let answered = match (early.take(), sent) {
        (Some(Err(error)), _) | (None, Err(error)) => Err(error),
        (Some(Ok(frame)), _) => Ok(Answered { frame, is_early: true }),
        (None, Ok(())) => tokio::select! {
            frame = next(stream) => frame.map(|frame| Answered { frame, is_early: false }),
            () = answer.closed() => return false,
        },
    };
    let is_usable = answered.is_ok();
    answer.send(answered).is_ok() && is_usable
}

async fn send(stream: &mut WebSocketStream<TcpStream>, frame: Vec<u8>) -> Result<()> {
    let sent = timeout(SEND_WAIT, stream.send(Message::Binary(frame.into()))).await;
    match sent {
        Ok(sent) => sent.map_err(|error| lost(&error)),
        Err(_) => bail!("the server takes nothing for {} s", SEND_WAIT.as_secs()),
    }
}

/// The next binary or text frame. Dropping this future loses no frame.
async fn next(stream: &mut WebSocketStream<TcpStream>) -> Result<Frame> {
    loop {
        match stream.next().await {
            Some(Ok(Message::Binary(bytes))) => return Ok(Frame::Binary(bytes)),
            Some(Ok(Message::Text(text))) => return Ok(Frame::Text(text.to_string())),
            Some(Ok(Message::Close(reason))) => {
                let reason = reason
                    .map(|reason| format!(" ({}: {})", reason.code, printable(&reason.reason)));
                bail!("the server closed the connection{}", reason.unwrap_or_default());
            }
            Some(Ok(_)) => {}
            Some(Err(error)) => return Err(lost(&error)),
            None => bail!("the server closed the connection"),
        }
    }
}

fn lost(error: &SocketError) -> anyhow::Error {
    match error {
        SocketError::Capacity(_) => {
            anyhow!("the server sent a frame of more than {FRAME_BYTES_MAX} bytes")
        }
        SocketError::ConnectionClosed
        | SocketError::AlreadyClosed
        | SocketError::Protocol(ProtocolError::ResetWithoutClosingHandshake) => {
            anyhow!("the server closed the connection")
        }
        other => anyhow!("the connection was lost: {}", printable(&other.to_string())),
    }
}
