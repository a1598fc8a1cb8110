//! A connection of any wire: observation in, actions out.

use std::time::Duration;

use anyhow::{Context, Result, bail};
use decision::{EpisodeName, Image};

use super::act;
use super::openpi::OpenPi;
use super::vla_eval::VlaEval;
use crate::codec::extension::{self, Announcement, Answer, Ask};
use crate::codec::{Array, KeyForm, Value, decode, json_numpy, openpi, vla_eval};
use crate::{Address, Profile, Wire};

/// What a server answers.
#[derive(Debug, Clone)]
pub struct Reply {
    /// One action or a chunk, in the server's units.
    pub actions: Vec<Vec<f32>>,
    /// The optional fields.
    pub answer: Option<Answer>,
}

/// An observation of the agent.
#[derive(Debug, Clone, PartialEq)]
pub struct Question {
    /// The camera image.
    pub image: Image,
    /// The robot's state.
    pub state: Vec<f32>,
    /// The language instruction.
    pub instruction: String,
    /// The optional fields, for a server that announced them.
    pub ask: Option<Ask>,
}

/// How to reach a server.
#[derive(Debug, Clone)]
pub struct Target {
    /// Its address.
    pub address: Address,
    /// Its key.
    pub key: Option<String>,
    /// The mapping.
    pub profile: Profile,
}

/// The metadata that a server sends to a new client.
#[derive(Debug, Clone, PartialEq)]
pub struct Greeting {
    /// openpi's metadata, the payload of vla-eval's hello, or nothing.
    pub bytes: Vec<u8>,
    /// The optional fields.
    pub announcement: Option<Announcement>,
}

/// A connection to a server.
pub enum Connection {
    OpenPi(OpenPi),
    VlaEval(VlaEval),
    Act,
}

impl Connection {
    /// Connects once.
    pub async fn open(target: &Target) -> Result<(Connection, Greeting)> {
        let (address, key) = (&target.address, target.key.as_deref());
        match address.wire {
            Wire::OpenPi => {
                let (connection, bytes) = OpenPi::connect(address, key).await?;
                let announcement = Announcement::read(&openpi::map(&bytes)?)?;
                Ok((Connection::OpenPi(connection), Greeting { bytes, announcement }))
            }
            Wire::VlaEval => {
                let (connection, bytes) = VlaEval::connect(address, key).await?;
                let hello = decode(&bytes)?;
                let announcement = hello.get("capabilities").map(Announcement::read);
                let announcement = announcement.transpose()?.flatten();
                Ok((Connection::VlaEval(connection), Greeting { bytes, announcement }))
            }
            Wire::Act => {
                act::check(address).await?;
                Ok((Connection::Act, Greeting { bytes: Vec::new(), announcement: None }))
            }
        }
    }

    /// Begins an episode, where the wire has that.
    pub async fn begin(&mut self, name: &EpisodeName) -> Result<()> {
        match self {
            Connection::VlaEval(connection) => connection.begin(name).await,
            Connection::OpenPi(_) | Connection::Act => Ok(()),
        }
    }

    /// Sends an observation and waits for its answer.
    pub async fn ask(&mut self, target: &Target, observation: &Value<'_>) -> Result<Reply> {
        let wait = Duration::from_secs(target.profile.server.answer_secs_max);
        match self {
            Connection::OpenPi(connection) => connection.ask(observation, wait).await,
            Connection::VlaEval(connection) => connection.ask(observation.clone(), wait).await,
            Connection::Act => {
                act::ask(&target.address, target.key.as_deref(), observation, wait).await
            }
        }
    }

    /// Ends the episode, where the wire has that. The server sees a lost connection by itself.
    pub async fn end(mut self) {
        if let Connection::VlaEval(connection) = &mut self {
            let _ = connection.end().await;
        }
    }
}

/// The fields that the profile names on this wire.
pub fn observation(target: &Target, question: &Question) -> Result<Value<'static>> {
    let (profile, wire) = (&target.profile, target.address.wire);
    let array = |array: Array<'static>| match wire {
        Wire::OpenPi => array.into_value(openpi::KEYS),
        Wire::VlaEval => array.into_value(vla_eval::KEYS),
        Wire::Act => json_numpy::array_value(&array),
    };
    let mut images = Vec::new();
    for input in &profile.images {
        let Some(name) = input.names.on(wire) else { continue };
        let image = input.fit(&question.image).with_context(|| format!("profile: {name}"))?;
        images.push((name.to_owned(), array(input.array(&image)?)));
    }
    let mut fields = match wire {
        Wire::VlaEval => vec![("images".to_owned(), map(images))],
        Wire::OpenPi | Wire::Act => images,
    };
    if let Some(input) = &profile.state
        && let Some(name) = input.names.on(wire)
    {
        let numbers = input.numbers(&question.state).context("profile")?;
        fields.push((name.to_owned(), array(Array::of_f32(vec![numbers.len()], &numbers)?)));
    }
    let Some(name) = profile.prompt.names.on(wire) else {
        bail!("profile: expected a name of the prompt")
    };
    let instruction = &question.instruction;
    let prompt =
        if profile.prompt.lower_case { instruction.to_lowercase() } else { instruction.clone() };
    fields.push((name.to_owned(), Value::Text(prompt.into())));
    if let (Wire::Act, Some(key)) = (wire, &profile.server.unnorm_key) {
        fields.push(("unnorm_key".to_owned(), Value::Text(key.clone().into())));
    }
    if let Some(ask) = &question.ask {
        fields.push((extension::KEY.to_owned(), ask.value()));
    }
    Ok(map(fields))
}

fn map(fields: Vec<(String, Value<'static>)>) -> Value<'static> {
    let key = |name: String| crate::codec::Key { name: name.into(), form: KeyForm::Text };
    Value::Map(fields.into_iter().map(|(name, value)| (key(name), value)).collect())
}
