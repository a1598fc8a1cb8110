//! vla-eval's wire: hello, then episodes of observations and actions. A failed observation is
//! answered with an error message; the connection stays.

use std::collections::VecDeque;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result};
use decision::{Action, TaskId, episode_name};

use super::action_form::{Gripper, Rotation};
use super::agent::ServedAgent;
use super::reply;
use super::session::Session;
use crate::codec::extension::{self, Ask};
use crate::codec::vla_eval::{self, Kind, Message, PROTOCOL_VERSION};
use crate::codec::{Array, Value};

/// One client.
pub(super) struct VlaEvalClient {
    session: Session,
    /// The name of the episode that the next observation begins, or why it has none: `episode_start`
    /// has no reply, so its error is the reply to that observation.
    starting: Option<Result<String>>,
    /// Observations that came without an episode: after a client's reconnection.
    unnamed: u64,
    /// The rest of a chunk: this wire has one action per observation.
    planned: VecDeque<Action>,
}

/// What to do after a message.
pub(super) enum Outcome {
    /// Send a reply.
    Reply(Vec<u8>),
    /// Nothing to send.
    Silence,
    /// Send this message, and close the connection.
    Refuse(Vec<u8>, String),
}

/// Whether a frame's value is a message of this wire rather than an observation of openpi's.
pub(super) fn is_message(value: &Value<'_>) -> bool {
    let is_text = value.get("type").is_some_and(|kind| kind.as_text().is_ok());
    is_text && value.get("payload").is_some() && value.get("seq").is_some()
}

impl VlaEvalClient {
    pub(super) fn new(session: Session) -> VlaEvalClient {
        VlaEvalClient { session, starting: None, unnamed: 0, planned: VecDeque::new() }
    }

    /// Handles one message.
    pub(super) async fn answer(&mut self, frame: &[u8], has_greeted: bool) -> Result<Outcome> {
        let message = match Message::decode(frame) {
            Ok(message) => message,
            Err(error) => {
                let reason = format!("{error:#}");
                return Ok(Outcome::Refuse(error_message(&reason, 0)?, reason));
            }
        };
        let sequence = message.sequence;
        match message.kind {
            Kind::Hello => match vla_eval::check_hello(&message.payload) {
                Ok(()) if has_greeted => Ok(Outcome::Silence),
                Ok(()) => Ok(Outcome::Reply(hello(self.session.agent(), sequence)?)),
                Err(error) => {
                    let reason = format!("{error:#}");
                    Ok(Outcome::Refuse(error_message(&reason, sequence)?, reason))
                }
            },
            Kind::EpisodeStart => {
                self.forget();
                self.starting = Some(episode_of(&message.payload));
                Ok(Outcome::Silence)
            }
            Kind::EpisodeEnd => {
                self.forget();
                Ok(Outcome::Silence)
            }
            Kind::Observation => Ok(Outcome::Reply(match self.act(&message.payload).await {
                Ok(payload) => self::message(Kind::Action, payload, sequence)?,
                Err(error) => {
                    self.forget();
                    tracing::warn!("vla-eval client: {error:#}");
                    error_message(&format!("observation_failed: {error:#}"), sequence)?
                }
            })),
            Kind::Error => {
                let reason = vla_eval::error_of(&message.payload);
                tracing::warn!("a vla-eval client reports an error: {reason}");
                Ok(Outcome::Silence)
            }
            Kind::Action => {
                let reason =
                    "expected hello, episode_start, observation or episode_end, got action";
                Ok(Outcome::Reply(error_message(reason, sequence)?))
            }
        }
    }

    fn forget(&mut self) {
        self.session.end();
        self.starting = None;
        self.planned.clear();
    }

    /// The payload of an action.
    async fn act(&mut self, payload: &Value<'_>) -> Result<Value<'static>> {
        if let Some(action) = self.planned.pop_front() {
            return Ok(Value::map([("actions", action_value(&action)?)]));
        }
        let agent = self.session.agent();
        let observation = agent.options.keys.read(payload, agent.info())?;
        let ask = Ask::read(payload)?.unwrap_or_default();
        if !self.session.is_running() {
            let instruction = &observation.instruction;
            let episode = match self.starting.take() {
                Some(episode) => episode.context("episode_start")?,
                None => {
                    self.unnamed += 1;
                    format!("{instruction}/default/{}", self.unnamed - 1)
                }
            };
            self.session.begin(&episode, instruction);
        }
        let decided = self.session.decide(observation, &ask).await?;
        let agent = self.session.agent();
        let mut actions = VecDeque::from(reply::actions(agent, &decided.decision));
        let first = actions.pop_front().context("expected an action, got none")?;
        // A client that asks for candidates decides by itself how much of a chunk it executes.
        let is_whole = ask.candidates.is_some();
        if !is_whole {
            self.planned = actions;
        }
        let answer = reply::answer(agent, &decided.decision, is_whole)?;
        Ok(Value::map([
            ("actions", action_value(&first)?),
            (extension::KEY, answer.value(vla_eval::KEYS)?),
        ]))
    }
}

fn action_value(action: &[f32]) -> Result<Value<'static>> {
    Ok(Array::of_f32(vec![action.len()], action)?.into_value(vla_eval::KEYS))
}

/// The episode's name in the derivation of its seeds, as in evaluations: `TASK/VARIANT/NUMBER`, where
/// vla-eval's task is named `TASK` or `TASK/VARIANT`.
fn episode_of(payload: &Value<'_>) -> Result<String> {
    let task = payload.field("task")?;
    let name = task.field("name").and_then(Value::as_text).context("task.name")?;
    let task_id: TaskId = name.parse().map_err(anyhow::Error::msg).context("task.name")?;
    let number: u32 = match task.get("episode_idx") {
        Some(number) => number.as_integer().context("task.episode_idx")?,
        None => 0,
    };
    Ok(episode_name(&task_id, number))
}

/// The server's hello.
pub(super) fn hello(agent: &ServedAgent, sequence: u64) -> Result<Vec<u8>> {
    message(Kind::Hello, hello_payload(agent)?, sequence)
}

/// What this server is, what it needs, and the conventions of its actions.
pub(super) fn hello_payload(agent: &ServedAgent) -> Result<Value<'static>> {
    let announcement = agent.announcement().value(vla_eval::KEYS)?;
    let mut payload = vec![
        ("harness_version", Value::text(concat!("rever ", env!("CARGO_PKG_VERSION")))),
        ("protocol_version", Value::Integer(PROTOCOL_VERSION)),
        ("model_server", Value::text("rever")),
        ("capabilities", Value::map([(extension::KEY, announcement)])),
    ];
    payload.push(("observation_params", observation_parameters(agent)));
    if agent.info().action_space.gripper == Some(6) {
        payload.push(("action_spec", action_spec(agent)));
    }
    payload.push((
        "observation_spec",
        Value::map([
            ("primary", dimensions("image", 0, "rgb_hwc_uint8")),
            ("language", dimensions("language", 0, "language")),
        ]),
    ));
    Ok(Value::map(payload))
}

/// Arguments for the benchmark's constructor; vla-eval drops those that it does not have.
fn observation_parameters(agent: &ServedAgent) -> Value<'static> {
    let (height, width) = agent.info().image_size;
    let side = |side: usize| Value::Integer(side as i128);
    Value::map([
        ("image_height", side(height)),
        ("image_width", side(width)),
        // For a verifier, which looks at the gripper's position, and for policies that read the state.
        ("send_state", Value::Bool(true)),
    ])
}

fn action_spec(agent: &ServedAgent) -> Value<'static> {
    let form = agent.options.form;
    let rotation = match form.rotation {
        Rotation::Vector => "axis_angle",
        Rotation::Euler => "euler_xyz",
    };
    let gripper = match form.gripper {
        Gripper::OpenPositive => "binary_close_negative",
        Gripper::ClosePositive => "binary_close_positive",
        Gripper::OpenOne => "continuous_01",
    };
    Value::map([
        ("position", dimensions("position", 3, "delta_xyz")),
        ("rotation", dimensions("rotation", 3, rotation)),
        ("gripper", dimensions("gripper", 1, gripper)),
    ])
}

fn dimensions(name: &'static str, count: i128, format: &'static str) -> Value<'static> {
    Value::map([
        ("name", Value::text(name)),
        ("dims", Value::Integer(count)),
        ("format", Value::text(format)),
    ])
}

fn message(kind: Kind, payload: Value<'static>, sequence: u64) -> Result<Vec<u8>> {
    let timestamp = now();
    Message { kind, payload, sequence, timestamp }.encode()
}

/// Seconds since 1970.
pub(super) fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

fn error_message(reason: &str, sequence: u64) -> Result<Vec<u8>> {
    let payload = Value::map([("error", Value::Text(reason.to_owned().into()))]);
    message(Kind::Error, payload, sequence)
}
