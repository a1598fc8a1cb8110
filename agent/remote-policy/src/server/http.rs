//! The paths of the port: WebSocket upgrades, health, configuration and `/act`.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use http_body_util::{BodyExt, Full, Limited};
use hyper::body::{Bytes, Incoming};
use hyper::header::{
    AUTHORIZATION, CONNECTION, CONTENT_TYPE, HeaderValue, ORIGIN, SEC_WEBSOCKET_ACCEPT,
    SEC_WEBSOCKET_KEY, SEC_WEBSOCKET_VERSION, UPGRADE,
};
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use serde_json::json;
use tokio::sync::OwnedSemaphorePermit;
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;
use tokio_tungstenite::tungstenite::protocol::{Role, WebSocketConfig};

use super::agent::ServedAgent;
use super::key::ApiKey;
use super::listen::MESSAGE_BYTES_MAX;
use super::{act, connection};

/// The time in which a body must have come.
const BODY_WAIT: Duration = Duration::from_secs(30);
/// The time in which an accepted upgrade must be complete.
const UPGRADE_WAIT: Duration = Duration::from_secs(10);
/// The version of WebSocket.
const WEBSOCKET_VERSION: &[u8] = b"13";

/// What the requests of one TCP connection share.
#[derive(Clone)]
pub(super) struct Service {
    pub agent: Arc<ServedAgent>,
    pub key: Option<ApiKey>,
    /// The place of this connection among the clients; also held by its WebSocket.
    pub place: Arc<OwnedSemaphorePermit>,
    /// Closes the WebSocket when the server stops.
    pub stop: tokio::sync::watch::Receiver<bool>,
}

type Reply = Response<Full<Bytes>>;

impl Service {
    /// Answers one request.
    pub async fn answer(self, request: Request<Incoming>) -> Result<Reply, Infallible> {
        let path = request.uri().path().to_owned();
        let is_health = ["/healthz", "/health"].contains(&&*path);
        if !is_health && let Some(refusal) = self.refusal(&request) {
            return Ok(refusal);
        }
        Ok(match (request.method(), &*path) {
            (&Method::GET, "/healthz") => text(StatusCode::OK, "text/plain", "OK\n"),
            (&Method::GET, "/health") => body(StatusCode::OK, &json!({ "status": "ok" })),
            (&Method::GET, "/config") => self.configuration(),
            (&Method::POST, "/act") => self.act(request).await,
            (&Method::GET, _) if is_upgrade(&request) => self.upgrade(request),
            (method, path) => error(
                StatusCode::NOT_FOUND,
                &format!(
                    "expected a WebSocket, GET /healthz, GET /health, GET /config or POST /act, got {method} {path}"
                ),
            ),
        })
    }

    /// Why a request is refused before it is looked at.
    fn refusal(&self, request: &Request<Incoming>) -> Option<Reply> {
        // Browsers send it; no page that somebody visits may use a server of this machine.
        if request.headers().contains_key(ORIGIN) {
            let reason = "expected no Origin header: this server does not answer web pages";
            return Some(error(StatusCode::FORBIDDEN, reason));
        }
        let header = request.headers().get(AUTHORIZATION).map(HeaderValue::as_bytes);
        match &self.key {
            Some(key) if !key.is_in(header) => {
                let reason =
                    "expected the header \"Authorization: Api-Key KEY\" with this server's key";
                Some(error(StatusCode::UNAUTHORIZED, reason))
            }
            _ => None,
        }
    }

    fn configuration(&self) -> Reply {
        let info = self.agent.info();
        let options = &self.agent.options;
        let config = json!({
            "policy": info.digest,
            "verifier": options.scorer.as_ref().map(|scorer| scorer.digest()),
            "setting": options.setting.to_string(),
            "seed": options.seed,
            "image_size": [info.image_size.0, info.image_size.1],
        });
        // vla-eval's tools read `applied` and `config`; nothing can be changed while it runs.
        body(StatusCode::OK, &json!({ "applied": {}, "config": config }))
    }

    async fn act(self, request: Request<Incoming>) -> Reply {
        let received = Limited::new(request.into_body(), MESSAGE_BYTES_MAX).collect();
        let received = match timeout(BODY_WAIT, received).await {
            Ok(Ok(received)) => received.to_bytes(),
            Ok(Err(reason)) => {
                let reason = format!("body: expected at most {MESSAGE_BYTES_MAX} bytes: {reason}");
                return error(StatusCode::PAYLOAD_TOO_LARGE, &reason);
            }
            Err(_) => return error(StatusCode::REQUEST_TIMEOUT, "body: expected it in time"),
        };
        match act::act(&self.agent, &received).await {
            Ok(reply) => text(StatusCode::OK, "application/json", &reply),
            Err(reason) => {
                tracing::warn!("/act: {reason:#}");
                error(StatusCode::BAD_REQUEST, &format!("{reason:#}"))
            }
        }
    }

    fn upgrade(self, mut request: Request<Incoming>) -> Reply {
        let headers = request.headers();
        let version = headers.get(SEC_WEBSOCKET_VERSION).map(HeaderValue::as_bytes);
        let key = headers.get(SEC_WEBSOCKET_KEY);
        let (Some(WEBSOCKET_VERSION), Some(key)) = (version, key) else {
            let reason = "expected version 13 of WebSocket and a key";
            return error(StatusCode::BAD_REQUEST, reason);
        };
        let accept = derive_accept_key(key.as_bytes());
        let upgraded = hyper::upgrade::on(&mut request);
        tokio::spawn(async move {
            let Ok(Ok(upgraded)) = timeout(UPGRADE_WAIT, upgraded).await else { return };
            let config = WebSocketConfig::default()
                .max_message_size(Some(MESSAGE_BYTES_MAX))
                .max_frame_size(Some(MESSAGE_BYTES_MAX));
            let io = TokioIo::new(upgraded);
            let socket = WebSocketStream::from_raw_socket(io, Role::Server, Some(config)).await;
            connection::serve(socket, self.agent, self.stop).await;
            drop(self.place);
        });
        let mut reply = Response::new(Full::default());
        *reply.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
        let headers = reply.headers_mut();
        headers.insert(CONNECTION, HeaderValue::from_static("Upgrade"));
        headers.insert(UPGRADE, HeaderValue::from_static("websocket"));
        if let Ok(accept) = HeaderValue::from_str(&accept) {
            headers.insert(SEC_WEBSOCKET_ACCEPT, accept);
        }
        reply
    }
}

fn is_upgrade(request: &Request<Incoming>) -> bool {
    let value = request.headers().get(UPGRADE).and_then(|value| value.to_str().ok());
    value.is_some_and(|value| value.eq_ignore_ascii_case("websocket"))
}

/// A request over the number of clients.
pub(super) fn busy(clients_max: usize) -> Reply {
    let reason = format!("all {clients_max} places for clients are taken (--max-clients)");
    error(StatusCode::SERVICE_UNAVAILABLE, &reason)
}

fn error(status: StatusCode, reason: &str) -> Reply {
    body(status, &json!({ "error": reason }))
}

fn body(status: StatusCode, value: &serde_json::Value) -> Reply {
    text(status, "application/json", &format!("{value}\n"))
}

fn text(status: StatusCode, kind: &'static str, text: &str) -> Reply {
    let mut reply = Response::new(Full::new(Bytes::copy_from_slice(text.as_bytes())));
    *reply.status_mut() = status;
    reply.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    reply
}
