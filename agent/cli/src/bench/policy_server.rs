//! Times decisions behind the policy server's wires against the same decisions in this process.

use std::io::Cursor;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use decision::{
    Decider, DecisionRequest, EpisodeContext, Image, Observation, Policy, Scorer, Setting,
};
use evaluation::statistics::quantile;
use futures_util::{SinkExt, StreamExt};
use image::{ImageFormat, RgbImage};
use remote_policy::codec::{Array, ImageForm, KeyForm, Value, decode, encode, image_value};
use remote_policy::server::{
    ActionForm, AgentOptions, ObservationKeys, ServedAgent, ServerOptions, serve,
};
use serde::Serialize;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{WebSocketStream, client_async};
use verifier::Verifier;

use super::decision::compared;

/// Rounds that are not counted, while caches fill.
const WARM_UP_ROUNDS: usize = 1;
/// Forms of a request, each with its own connection.
const WIRES: [&str; 2] = ["openpi, array", "vla-eval, PNG"];
/// The index of the wire that has episodes.
const VLA_EVAL: usize = 1;

/// The results of one wire.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// The wire, and how it encodes the image.
    pub wire: &'static str,
    /// Decisions behind every figure.
    pub decisions: usize,
    /// Size of a request.
    pub request_bytes: usize,
    /// Time of a decision in this process, median.
    pub decision_ms_p50: f64,
    /// Time from the request's first byte to the decoded reply, median.
    pub served_ms_p50: f64,
    /// Difference of the same decision behind the wire and in this process, median over the pairs.
    pub overhead_ms_p50: f64,
}

/// The parameters of the benchmark.
pub struct PolicyServerBench<'a> {
    /// The policy that proposes candidates.
    pub policy: Arc<dyn Policy>,
    /// The verifier that scores them; without one the medoid is executed.
    pub verifier: Option<Arc<Verifier>>,
    /// The observations, with images in the size that clients send.
    pub observations: &'a [Observation],
    /// Candidates per decision.
    pub candidates: u32,
    /// Counted passes over all observations.
    pub rounds: usize,
    /// Drives server, clients and decider.
    pub runtime: &'a tokio::runtime::Runtime,
}

type Socket = WebSocketStream<TcpStream>;

impl PolicyServerBench<'_> {
    /// Measures one wire after the other, with one client at a time: a batch would wait for a second
    /// one. The same decisions in this process alternate with them, first in every second pair.
    pub fn run(&self) -> Result<Vec<Row>> {
        let measure = |(wire, name)| self.measure(wire).context(name);
        WIRES.into_iter().enumerate().map(measure).collect()
    }

    fn measure(&self, wire: usize) -> Result<Row> {
        let (stop, stopped) = watch::channel(false);
        let mut socket = self.runtime.block_on(self.start(wire, stopped))?;
        let decider = Decider::new(Arc::clone(&self.policy));
        let (mut ours, mut theirs, mut request_bytes) = (Vec::new(), Vec::new(), 0);
        for round in 0..WARM_UP_ROUNDS + self.rounds {
            for (index, observation) in self.observations.iter().enumerate() {
                let seed = (round * self.observations.len() + index) as u64;
                let request = request(wire, observation, seed)?;
                request_bytes = request.len();
                let mut own = None;
                if (round + index) % 2 == 0 {
                    own = Some(self.decide(&decider, observation, seed)?);
                }
                let (served_ms, served) = self.runtime.block_on(async {
                    if wire == VLA_EVAL {
                        begin_episode(&mut socket).await?;
                    }
                    ask(&mut socket, request).await
                })?;
                let (own_ms, own) = match own {
                    Some(own) => own,
                    None => self.decide(&decider, observation, seed)?,
                };
                ensure!(
                    served.starts_with(&own),
                    "expected the action {own:?} of this process, got {served:?}"
                );
                if round >= WARM_UP_ROUNDS {
                    ours.push(own_ms);
                    theirs.push(served_ms);
                }
            }
        }
        stop.send_replace(true);
        Ok(row(WIRES[wire], &ours, theirs, request_bytes))
    }

    fn setting(&self) -> Setting {
        Setting::new(compared(self.verifier.is_some()), self.candidates, 1.0)
    }

    fn scorer(&self) -> Option<Arc<dyn Scorer>> {
        self.verifier.clone().map(|verifier| verifier as Arc<dyn Scorer>)
    }

    /// Starts a server on a free port and connects a client.
    async fn start(&self, wire: usize, stopped: watch::Receiver<bool>) -> Result<Socket> {
        let agent = ServedAgent::start(AgentOptions {
            candidates_max: 0,
            policy: Arc::clone(&self.policy),
            scorer: self.scorer(),
            setting: self.setting(),
            seed: 0,
            form: ActionForm::default(),
            keys: ObservationKeys::default(),
        })?;
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let address = listener.local_addr()?;
        let options = ServerOptions { key: None, clients_max: 1 };
        tokio::spawn(serve(listener, agent, options, stopped));
        let stream = TcpStream::connect(address).await?;
        stream.set_nodelay(true)?;
        let (mut socket, _) = client_async(format!("ws://{address}/"), stream).await?;
        // The server's first frame is metadata and hello.
        receive(&mut socket).await?;
        if wire == VLA_EVAL {
            let version = Value::map([("protocol_version", Value::Integer(1))]);
            send(&mut socket, &message("hello", version)).await?;
        }
        Ok(socket)
    }

    /// The milliseconds of one decision in this process, and its first action.
    fn decide(
        &self,
        decider: &Decider,
        observation: &Observation,
        seed: u64,
    ) -> Result<(f64, Vec<f32>)> {
        let image = decision::fit_image(observation.image.clone(), self.policy.info().image_size)?;
        let observation = Observation { image, ..observation.clone() };
        let begun = Instant::now();
        let instruction = observation.instruction.clone();
        let mut context = EpisodeContext::new(self.setting(), 0, instruction, self.scorer(), &[]);
        context.decision_seed = Some(seed);
        let request = DecisionRequest { observation: &observation, context: &mut context };
        let decided = self.runtime.block_on(decider.decide(vec![request]));
        let decision = decided.into_iter().next().context("no decision")??;
        let ms = begun.elapsed().as_secs_f64() * 1e3;
        ensure!(decision.chosen.is_some(), "expected a well-formed candidate, got none");
        Ok((ms, decision.actions.first().to_vec()))
    }
}

fn row(wire: &'static str, ours: &[f64], mut theirs: Vec<f64>, request_bytes: usize) -> Row {
    let sorted = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values
    };
    let overhead = sorted(theirs.iter().zip(ours).map(|(served, own)| served - own).collect());
    theirs = sorted(theirs);
    Row {
        wire,
        decisions: theirs.len(),
        request_bytes,
        decision_ms_p50: quantile(&sorted(ours.to_vec()), 0.5),
        served_ms_p50: quantile(&theirs, 0.5),
        overhead_ms_p50: quantile(&overhead, 0.5),
    }
}

/// A request for one decision in an episode of its own.
fn request(wire: usize, observation: &Observation, seed: u64) -> Result<Vec<u8>> {
    let rever = Value::map([
        ("seed", Value::Integer(seed.into())),
        ("episode", Value::Text(seed.to_string().into())),
    ]);
    let instruction = Value::text(&observation.instruction);
    let keys = if wire == VLA_EVAL { KeyForm::Text } else { KeyForm::Bytes };
    let state = Array::of_f32(vec![observation.state.len()], &observation.state)?.into_value(keys);
    if wire != VLA_EVAL {
        return encode(&Value::map([
            ("observation/image", image_value(&observation.image, ImageForm::Array(keys))?),
            ("observation/state", state),
            ("prompt", instruction),
            ("rever", rever),
        ]));
    }
    encode(&message(
        "observation",
        Value::map([
            ("images", Value::map([("primary", png(&observation.image)?)])),
            ("states", state),
            ("task_description", instruction),
            ("rever", rever),
        ]),
    ))
}

fn message<'a>(kind: &'static str, payload: Value<'a>) -> Value<'a> {
    Value::map([
        ("type", Value::text(kind)),
        ("payload", payload),
        ("seq", Value::Integer(1)),
        ("timestamp", Value::Float(0.0)),
    ])
}

/// vla-eval's default: PNG.
fn png(image: &Image) -> Result<Value<'static>> {
    let (width, height) = (image.width as u32, image.height as u32);
    let pixels = RgbImage::from_raw(width, height, image.pixels.to_vec());
    let mut bytes = Cursor::new(Vec::new());
    pixels.context("expected an RGB image")?.write_to(&mut bytes, ImageFormat::Png)?;
    let shape = [image.height, image.width, 3].map(|length| Value::Integer(length as i128));
    Ok(Value::map([
        ("__image__", Value::Bool(true)),
        ("format", Value::text("png")),
        ("data", Value::Bytes(bytes.into_inner().into())),
        ("shape", Value::List(shape.to_vec())),
    ]))
}

/// An episode without a memory of the last decision.
async fn begin_episode(socket: &mut Socket) -> Result<()> {
    let task = Value::map([("name", Value::text("bench"))]);
    send(socket, &message("episode_start", Value::map([("task", task)]))).await
}

async fn send(socket: &mut Socket, value: &Value<'_>) -> Result<()> {
    Ok(socket.send(Message::binary(encode(value)?)).await?)
}

/// Milliseconds from the request to its decoded reply, and the actions, one after the other.
async fn ask(socket: &mut Socket, request: Vec<u8>) -> Result<(f64, Vec<f32>)> {
    let begun = Instant::now();
    socket.send(Message::binary(request)).await?;
    let reply = receive(socket).await?;
    let reply = decode(&reply)?;
    let result = reply.get("payload").unwrap_or(&reply);
    let actions = Array::from_value(result.field("actions")?)?.to_f32();
    Ok((begun.elapsed().as_secs_f64() * 1e3, actions))
}

async fn receive(socket: &mut Socket) -> Result<Vec<u8>> {
    match socket.next().await.context("expected a frame, got the end")?? {
        Message::Binary(bytes) => Ok(bytes.to_vec()),
        other => anyhow::bail!("expected a binary frame, got {other:?}"),
    }
}
