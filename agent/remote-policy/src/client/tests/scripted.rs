//! A WebSocket server that answers as a test says.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use futures_util::{SinkExt, StreamExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{WebSocketStream, accept_async};

use crate::codec::extension::{Answer, KEY};
use crate::codec::vla_eval::{self, Kind};
use crate::codec::{Array, KeyForm, Value, actions_array, encode, openpi};

/// What a server does with a frame: `None` closes the connection.
pub type Script = Arc<dyn Fn(usize, &[u8]) -> Option<Vec<Message>> + Send + Sync>;

/// Binary frames with the numbers of their connections.
pub type Received = Arc<Mutex<Vec<(usize, Vec<u8>)>>>;

/// A running server; dropping it closes its port and its connections.
pub struct Scripted {
    /// Where it listens.
    pub place: SocketAddr,
    /// All binary frames that it received, with the number of their connection.
    pub received: Received,
    _runtime: Runtime,
}

impl Scripted {
    /// Starts a server. `greeting` is sent when a client has connected.
    pub fn start(port: u16, greeting: Vec<Message>, script: Script) -> Scripted {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .expect("a runtime");
        let listener = runtime.block_on(TcpListener::bind(("127.0.0.1", port))).expect("a port");
        let place = listener.local_addr().expect("an address");
        let received = Received::default();
        let kept = Arc::clone(&received);
        runtime.spawn(async move {
            let connections = AtomicUsize::new(0);
            while let Ok((stream, _)) = listener.accept().await {
                let index = connections.fetch_add(1, Ordering::Relaxed);
                let (greeting, script, kept) =
                    (greeting.clone(), Arc::clone(&script), Arc::clone(&kept));
                tokio::spawn(async move {
                    if let Ok(stream) = accept_async(stream).await {
                        answer(index, stream, greeting, script, kept).await;
                    }
                });
            }
        });
        Scripted { place, received, _runtime: runtime }
    }
}

async fn answer(
    index: usize,
    mut stream: WebSocketStream<TcpStream>,
    greeting: Vec<Message>,
    script: Script,
    kept: Received,
) {
    for message in greeting {
        if stream.send(message).await.is_err() {
            return;
        }
    }
    while let Some(Ok(message)) = stream.next().await {
        let Message::Binary(frame) = message else { continue };
        kept.lock().expect("not poisoned").push((index, frame.to_vec()));
        let Some(answers) = script(index, &frame) else { return };
        for message in answers {
            if stream.send(message).await.is_err() {
                return;
            }
        }
    }
}

/// A chunk of two actions that move by x.
pub fn chunk(x: f32) -> Array<'static> {
    let action = |x| vec![x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    actions_array(&[action(x), action(x / 2.0)]).expect("an array")
}

/// A binary frame of a map.
pub fn frame(map: &Value<'_>) -> Message {
    Message::Binary(encode(map).expect("encodes").into())
}

/// An openpi result that moves by x.
pub fn result(x: f32) -> Message {
    frame(&Value::map([("actions", chunk(x).into_value(openpi::KEYS))]))
}

/// An openpi result with optional fields.
pub fn result_with(answer: &Answer) -> Message {
    let fields = answer.value(KeyForm::Bytes).expect("encodes");
    frame(&Value::map([("actions", chunk(0.0).into_value(openpi::KEYS)), (KEY, fields)]))
}

/// openpi's first frame without any metadata.
pub fn metadata() -> Vec<Message> {
    vec![frame(&Value::map([]))]
}

/// A vla-eval message with this number.
pub fn message(kind: Kind, payload: Value<'static>, sequence: u64) -> Message {
    let message = vla_eval::Message { kind, payload, sequence, timestamp: 0.0 };
    Message::Binary(message.encode().expect("encodes").into())
}
