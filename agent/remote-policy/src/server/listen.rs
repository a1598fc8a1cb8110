//! Accepts clients on one TCP port until the server is stopped.

use std::sync::Arc;
use std::time::Duration;

use anyhow::Result;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use socket2::{SockRef, TcpKeepalive};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::agent::ServedAgent;
use super::http::{Service, busy};
use super::key::ApiKey;

/// Maximum size of a message. An uncompressed image of 1024 x 1024 pixels has 3 MB.
pub const MESSAGE_BYTES_MAX: usize = 16 * 1024 * 1024;
/// Timeout for the head of a request.
const HEADER_WAIT: Duration = Duration::from_secs(10);
/// Maximum size of a request's head.
const HEADER_BYTES_MAX: usize = 64 * 1024;
/// Maximum number of connections that are being refused with status 503; further ones are dropped.
const REFUSALS_MAX: usize = 16;
/// A dead machine is noticed after this time without a packet.
const KEEPALIVE: Duration = Duration::from_secs(60);
/// Pause after an error of the system, such as too many open files.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// How long the server waits for its connections to close.
const STOP_WAIT: Duration = Duration::from_secs(2);

/// Limits and access.
#[derive(Debug, Clone)]
pub struct ServerOptions {
    /// What clients must send; none for a server that anybody who reaches it may use.
    pub key: Option<ApiKey>,
    /// Clients at once.
    pub clients_max: usize,
}

/// Serves clients until `stop` is true.
pub async fn serve(
    listener: TcpListener,
    agent: Arc<ServedAgent>,
    options: ServerOptions,
    mut stop: watch::Receiver<bool>,
) -> Result<()> {
    let places = Arc::new(Semaphore::new(options.clients_max));
    let refusals = Arc::new(Semaphore::new(REFUSALS_MAX));
    let mut connections = JoinSet::new();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            _ = stop.wait_for(|stop| *stop) => break,
        };
        let stream = match accepted {
            Ok((stream, _)) => stream,
            Err(error) => {
                tracing::warn!("cannot accept a connection: {error}");
                match timeout(ACCEPT_PAUSE, stop.wait_for(|stop| *stop)).await {
                    Ok(_) => break,
                    Err(_) => continue,
                }
            }
        };
        prepare(&stream);
        while connections.try_join_next().is_some() {}
        if let Ok(place) = Arc::clone(&places).try_acquire_owned() {
            let service = Service {
                agent: Arc::clone(&agent),
                key: options.key.clone(),
                place: Arc::new(place),
                stop: stop.clone(),
            };
            connections.spawn(speak(stream, service));
        } else if let Ok(refusal) = Arc::clone(&refusals).try_acquire_owned() {
            let clients_max = options.clients_max;
            connections.spawn(async move {
                let _refusal = refusal;
                refuse(stream, clients_max).await;
            });
        }
    }
    // WebSockets hold their places until they are closed.
    let all = places.acquire_many(u32::try_from(options.clients_max)?);
    if timeout(STOP_WAIT, all).await.is_err() {
        tracing::warn!("some clients did not close their connections in time");
    }
    Ok(())
}

/// Without delays for small packets, and with probes of silent peers.
fn prepare(stream: &TcpStream) {
    let socket = SockRef::from(stream);
    let keepalive = TcpKeepalive::new().with_time(KEEPALIVE).with_interval(KEEPALIVE / 4);
    let result = stream.set_nodelay(true).and_then(|()| socket.set_tcp_keepalive(&keepalive));
    if let Err(error) = result {
        tracing::debug!("options of a socket: {error}");
    }
}

async fn speak(stream: TcpStream, service: Service) {
    let mut stop = service.stop.clone();
    let answer = service_fn(move |request| service.clone().answer(request));
    let connection = http().serve_connection(TokioIo::new(stream), answer).with_upgrades();
    tokio::select! {
        // A client that breaks HTTP has been answered by the library.
        result = connection => if let Err(error) = result {
            tracing::debug!("HTTP: {error}");
        },
        _ = stop.wait_for(|stop| *stop) => {}
    }
}

async fn refuse(stream: TcpStream, clients_max: usize) {
    let answer =
        service_fn(move |_| async move { Ok::<_, std::convert::Infallible>(busy(clients_max)) });
    let mut builder = http();
    let connection = builder.keep_alive(false).serve_connection(TokioIo::new(stream), answer);
    let _ = timeout(HEADER_WAIT, connection).await;
}

fn http() -> http1::Builder {
    let mut builder = http1::Builder::new();
    builder
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_WAIT)
        .max_buf_size(HEADER_BYTES_MAX);
    builder
}
