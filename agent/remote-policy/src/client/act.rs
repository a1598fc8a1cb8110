//! OpenVLA's `/act`: one HTTP request per action.

use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail, ensure};
use http_body_util::{BodyExt, Full, Limited};
use hyper::body::Bytes;
use hyper::client::conn::http1;
use hyper::header::{AUTHORIZATION, CONNECTION, CONTENT_TYPE, HOST};
use hyper_util::rt::TokioIo;
use tokio::net::TcpStream;
use tokio::time::timeout;

use super::connection::Reply;
use super::socket::CONNECT_WAIT;
use crate::Address;
use crate::codec::{FRAME_BYTES_MAX, Value, actions_of, json_numpy, openpi, printable};

/// Sends an observation and waits for its action.
pub async fn ask(
    address: &Address,
    key: Option<&str>,
    observation: &Value<'_>,
    wait: Duration,
) -> Result<Reply> {
    let body = json_numpy::encode(observation)?;
    let reply = timeout(wait, post(address, key, body)).await;
    let reply = reply.map_err(|_| anyhow!("no answer within {} s", wait.as_secs()))??;
    let body = json_numpy::decode(&reply)?;
    if let Value::Text(text) = &body.value {
        bail!("the server failed: it answered {:?}; its own log says why", printable(text));
    }
    let array = json_numpy::array(&body.value)?;
    Ok(Reply { actions: actions_of(&array)?, answer: None })
}

/// Checks that something listens.
pub async fn check(address: &Address) -> Result<()> {
    connect(address).await.map(drop)
}

async fn connect(address: &Address) -> Result<TcpStream> {
    let stream = timeout(CONNECT_WAIT, TcpStream::connect(address.authority())).await;
    let stream = stream.map_err(|_| anyhow!("no answer within {} s", CONNECT_WAIT.as_secs()))?;
    stream.context("cannot connect")
}

async fn post(address: &Address, key: Option<&str>, body: String) -> Result<Bytes> {
    let stream = connect(address).await?;
    stream.set_nodelay(true).context("cannot set TCP_NODELAY")?;
    let (mut sender, connection) = http1::handshake(TokioIo::new(stream)).await?;
    let connection = tokio::spawn(connection);
    let mut request = hyper::Request::post(&address.path)
        .header(HOST, address.authority())
        .header(CONTENT_TYPE, "application/json")
        .header(CONNECTION, "close");
    if let Some(key) = key {
        request = request.header(AUTHORIZATION, openpi::authorization(key));
    }
    let request = request.body(Full::new(Bytes::from(body)))?;
    let reply = async {
        let response = sender.send_request(request).await.context("the connection was lost")?;
        let status = response.status();
        let body = Limited::new(response.into_body(), FRAME_BYTES_MAX).collect().await;
        let body = body.map_err(|error| anyhow!("answer: {error}"))?.to_bytes();
        ensure!(
            status.is_success(),
            "the server answered {status}: {}",
            printable(&String::from_utf8_lossy(&body[..body.len().min(1000)]))
        );
        Ok(body)
    };
    let reply = reply.await;
    connection.abort();
    reply
}
