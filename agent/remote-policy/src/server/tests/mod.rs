//! The server over real sockets, with a policy whose actions show what it was given.

mod access;
mod hostile;
mod wires;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Result;
use async_trait::async_trait;
use decision::{
    ActionChunk, ActionSpace, Candidate, Parsed, Policy, PolicyInfo, Proposal, ProposalRequest,
    Reasoning, Setting, Strategy,
};
use futures_util::{SinkExt, StreamExt};
use sha2::{Digest, Sha256};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::{WebSocketStream, client_async};

use super::{
    ActionForm, AgentOptions, ApiKey, CANDIDATES_MAX, ObservationKeys, ServedAgent, ServerOptions,
    serve,
};
use crate::codec::{Array, Dtype, KeyForm, Value, decode, encode};

/// No reply takes longer.
const WAIT: Duration = Duration::from_secs(30);
const SIDE: usize = 4;

/// A policy whose actions are a hash of everything that it may depend on.
pub struct Echo {
    info: PolicyInfo,
    /// Actions per chunk.
    steps: usize,
}

impl Echo {
    pub fn new(steps: usize) -> Echo {
        let info = PolicyInfo {
            digest: "echo".to_owned(),
            image_size: (SIDE, SIDE),
            action_space: ActionSpace { scale: vec![1.0; 7], gripper: Some(6) },
            hidden_size: None,
            parallel_calls: 1,
        };
        Echo { info, steps }
    }
}

/// The x motion of one candidate's action.
pub fn motion(instruction: &str, pixels: &[u8], seed: u64, candidate: usize, step: usize) -> f32 {
    let digest = Sha256::digest(format!("{instruction}/{pixels:?}/{seed}/{candidate}/{step}"));
    f32::from(digest[0]) + f32::from(digest[1]) / 256.0
}

#[async_trait]
impl Policy for Echo {
    fn info(&self) -> &PolicyInfo {
        &self.info
    }

    async fn propose(&self, requests: &[ProposalRequest<'_>]) -> Result<Vec<Proposal>> {
        requests.iter().map(|request| self.proposal(request)).collect()
    }
}

impl Echo {
    fn proposal(&self, request: &ProposalRequest<'_>) -> Result<Proposal> {
        anyhow::ensure!(request.instruction != "fail", "expected another instruction");
        let candidate = |index| {
            let x = |step| {
                motion(request.instruction, &request.image.pixels, request.seed, index, step)
            };
            let actions = (0..self.steps).map(|step| vec![x(step), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
            Ok(Candidate {
                tokens: Vec::new(),
                log_probability: -1.0,
                log_probabilities: Vec::new(),
                confidence: Vec::new(),
                hidden: Vec::new(),
                parsed: Ok(Parsed {
                    reasoning: Reasoning::default(),
                    action_tokens: Vec::new(),
                    actions: ActionChunk::new(actions.collect())?,
                }),
            })
        };
        Ok(Proposal { candidates: (0..request.candidates).map(candidate).collect::<Result<_>>()? })
    }
}

/// A server, stopped when this is dropped.
pub struct Server {
    pub address: SocketAddr,
    stop: watch::Sender<bool>,
}

pub fn agent(steps: usize, strategy: Strategy, candidates: u32) -> Arc<ServedAgent> {
    let options = AgentOptions {
        candidates_max: CANDIDATES_MAX,
        policy: Arc::new(Echo::new(steps)),
        scorer: None,
        setting: Setting::new(strategy, candidates, 1.0),
        seed: 7,
        form: ActionForm::default(),
        keys: ObservationKeys::default(),
    };
    ServedAgent::start(options).expect("an agent")
}

impl Server {
    pub async fn start(steps: usize) -> Server {
        Server::with(agent(steps, Strategy::Sample, 1), None, 16).await
    }

    pub async fn with(agent: Arc<ServedAgent>, key: Option<&str>, clients_max: usize) -> Server {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("an address");
        let (stop, stopped) = watch::channel(false);
        let key = key.map(|key| ApiKey::new(key).expect("a key"));
        let options = ServerOptions { key, clients_max };
        tokio::spawn(serve(listener, agent, options, stopped));
        Server { address, stop }
    }

    pub async fn connect(&self) -> Client {
        self.connect_with(&[]).await.expect("a WebSocket")
    }

    pub async fn connect_with(&self, headers: &[(&'static str, &str)]) -> Result<Client> {
        let stream = TcpStream::connect(self.address).await?;
        let mut request = format!("ws://{}/", self.address).into_client_request()?;
        for (name, value) in headers {
            request.headers_mut().insert(*name, value.parse()?);
        }
        let (socket, _) = timeout(WAIT, client_async(request, stream)).await??;
        Ok(Client { socket })
    }

    pub fn stop(&self) {
        self.stop.send_replace(true);
    }
}

/// One WebSocket.
pub struct Client {
    pub socket: WebSocketStream<TcpStream>,
}

impl Client {
    pub async fn send(&mut self, value: &Value<'_>) {
        let frame = encode(value).expect("a frame");
        self.socket.send(Message::binary(frame)).await.expect("sent");
    }

    pub async fn receive(&mut self) -> Message {
        let message = timeout(WAIT, self.socket.next()).await.expect("in time");
        message.expect("a message").expect("no error")
    }

    pub async fn receive_binary(&mut self) -> Vec<u8> {
        match self.receive().await {
            Message::Binary(bytes) => bytes.to_vec(),
            other => panic!("expected a binary frame, got {other:?}"),
        }
    }

    /// The code and the reason of the server's close.
    pub async fn closed(&mut self) -> (u16, String) {
        match self.receive().await {
            Message::Close(Some(frame)) => (frame.code.into(), frame.reason.to_string()),
            other => panic!("expected a close, got {other:?}"),
        }
    }
}

pub fn pixels(shade: u8) -> Vec<u8> {
    vec![shade; SIDE * SIDE * 3]
}

pub fn image(shade: u8, form: KeyForm) -> Value<'static> {
    Array::new(Dtype::U8, vec![SIDE, SIDE, 3], pixels(shade)).expect("an image").into_value(form)
}

/// The x motions of a reply's actions.
pub fn motions(actions: &Value<'_>) -> Vec<f32> {
    let array = Array::from_value(actions).expect("an array");
    array.to_f32().chunks(7).map(|action| action[0]).collect()
}

/// The value of a frame, without a borrow.
pub fn read<T>(frame: &[u8], read: impl FnOnce(&Value<'_>) -> T) -> T {
    read(&decode(frame).expect("a frame"))
}
