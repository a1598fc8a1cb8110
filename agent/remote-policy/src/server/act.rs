//! OpenVLA's `/act`: one observation as JSON, one action as JSON. Every request is an episode of its
//! own, because this wire has neither connections nor episodes.

use std::sync::Arc;

use anyhow::Result;
use decision::Observation;
use sha2::{Digest, Sha256};

use super::agent::ServedAgent;
use super::reply;
use super::session::Session;
use crate::codec::extension::Ask;
use crate::codec::{Array, Key, KeyForm, Value, json_numpy};

/// Keys of a request that hold arrays.
const ARRAYS: [&str; 4] = ["image", "full_image", "state", "proprio"];

/// The reply's body: an action, or a chunk of actions with more than one step.
pub(super) async fn act(agent: &Arc<ServedAgent>, body: &[u8]) -> Result<String> {
    let body = json_numpy::decode(body)?;
    let value = with_arrays(&body.value)?;
    let observation = agent.options.keys.read(&value, agent.info())?;
    let ask = Ask::read(&value)?.unwrap_or_default();
    let _active = agent.batcher.activate();
    let mut session = Session::new(Arc::clone(agent));
    session.begin(&digest(&observation), &observation.instruction);
    let decided = session.decide(observation, &ask).await?;
    let actions = reply::actions(agent, &decided.decision);
    let dimensions = actions[0].len();
    let shape = match actions.len() {
        1 => vec![dimensions],
        steps => vec![steps, dimensions],
    };
    let array = Array::of_f32(shape, &actions.concat())?;
    let text = json_numpy::encode(&json_numpy::array_value(&array))?;
    match body.is_encoded {
        true => Ok(serde_json::Value::String(text).to_string()),
        false => Ok(text),
    }
}

/// The request with its arrays in the form of the other wires.
fn with_arrays(value: &Value<'static>) -> Result<Value<'static>> {
    let entry = |(key, value): &(Key<'static>, Value<'static>)| {
        let value = match ARRAYS.contains(&&*key.name) {
            true => {
                let Array { dtype, shape, bytes } = json_numpy::array(value)?;
                Array { dtype, shape, bytes: bytes.into_owned().into() }.into_value(KeyForm::Text)
            }
            false => value.clone(),
        };
        Ok((key.clone(), value))
    };
    Ok(Value::Map(value.entries()?.iter().map(entry).collect::<Result<_>>()?))
}

/// The name of a request's episode: equal observations get equal actions, others another random
/// stream.
fn digest(observation: &Observation) -> String {
    let digest = Sha256::new()
        .chain_update(&observation.image.pixels)
        .chain_update(&observation.instruction)
        .finalize();
    digest.iter().take(16).map(|byte| format!("{byte:02x}")).collect()
}
