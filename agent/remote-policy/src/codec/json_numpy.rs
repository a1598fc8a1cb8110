//! OpenVLA's `/act` wire: JSON in which an array is a map of its bytes in base64, its type and its
//! shape. A body may also be `{"encoded": TEXT}` where the text is JSON again; the reply is then a
//! JSON text that holds JSON.

use std::borrow::Cow;

use anyhow::{Context, Result, bail, ensure};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::de::{DeserializeSeed, Deserializer, Error, MapAccess, SeqAccess, Visitor};

use super::{Array, DEPTH_MAX, Dtype, FRAME_BYTES_MAX, ITEMS_MAX, Key, Value};

/// A decoded body.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// Arrays in it are read with [`array`].
    pub value: Value<'static>,
    /// Whether it came as a text inside the JSON.
    pub is_encoded: bool,
}

/// Decodes the body of a request or a reply, encoded once or twice.
pub fn decode(body: &[u8]) -> Result<Body> {
    let value = parse(body)?;
    let inner = match &value {
        Value::Text(text) => Some(text),
        Value::Map(entries) => match &entries[..] {
            [(key, Value::Text(text))] if key.name == "encoded" => Some(text),
            _ => None,
        },
        _ => None,
    };
    match inner.filter(|text| !is_error(text)) {
        Some(text) => Ok(Body { value: parse(text.as_bytes())?, is_encoded: true }),
        None => Ok(Body { value, is_encoded: false }),
    }
}

/// The text that OpenVLA's script replies after an exception.
fn is_error(text: &str) -> bool {
    text == "error"
}

/// Encodes a body, for the second form inside a text.
pub fn encode(value: &Value<'_>) -> Result<String> {
    Ok(json(value)?.to_string())
}

/// Wraps an encoded request in the second form.
#[cfg(test)]
pub fn encode_twice(body: &str) -> String {
    serde_json::json!({ "encoded": body }).to_string()
}

/// Reads an array: `__numpy__`, or nested lists of numbers.
pub fn array<'a>(value: &'a Value<'_>) -> Result<Array<'a>> {
    if value.get("__numpy__").is_none() {
        return Array::from_value(value);
    }
    let data = value.field("__numpy__")?.as_text().context("array: __numpy__")?;
    let bytes = STANDARD.decode(data).context("array: expected base64 in __numpy__")?;
    let dtype = Dtype::parse(value.field("dtype")?.as_text().context("array: dtype")?)?;
    let Value::List(shape) = value.field("shape")? else {
        bail!("array: expected a list as shape, got {}", value.field("shape")?.kind());
    };
    let shape = shape.iter().map(Value::as_integer).collect::<Result<_>>();
    Array::new(dtype, shape.context("array: shape")?, bytes)
}

/// The map that encodes an array.
pub fn array_value(array: &Array<'_>) -> Value<'static> {
    let shape = array.shape.iter().map(|length| Value::Integer(*length as i128)).collect();
    Value::map([
        ("__numpy__", Value::Text(STANDARD.encode(&array.bytes).into())),
        ("dtype", Value::Text(array.dtype.text().into())),
        ("shape", Value::List(shape)),
    ])
}

fn json(value: &Value<'_>) -> Result<serde_json::Value> {
    Ok(match value {
        Value::Nil => serde_json::Value::Null,
        Value::Bool(value) => (*value).into(),
        Value::Integer(integer) => match (u64::try_from(*integer), i64::try_from(*integer)) {
            (Ok(number), _) => number.into(),
            (_, Ok(number)) => number.into(),
            _ => bail!("integer: expected at most 64 bits, got {integer}"),
        },
        Value::Float(float) => (*float).into(),
        Value::Text(text) => (&**text).into(),
        Value::Bytes(_) => bail!("JSON: expected no bytes"),
        Value::List(values) => values.iter().map(json).collect::<Result<Vec<_>>>()?.into(),
        Value::Map(entries) => {
            let entry =
                |(key, value): &(Key<'_>, Value<'_>)| Ok((key.name.to_string(), json(value)?));
            serde_json::Value::Object(entries.iter().map(entry).collect::<Result<_>>()?)
        }
    })
}

fn parse(body: &[u8]) -> Result<Value<'static>> {
    let bytes = body.len();
    ensure!(
        bytes <= FRAME_BYTES_MAX,
        "body: expected at most {FRAME_BYTES_MAX} bytes, got {bytes}"
    );
    let mut reader = serde_json::Deserializer::from_slice(body);
    let mut items = 0;
    let value = Bounded { items: &mut items, depth: 0 }.deserialize(&mut reader);
    let value = value.context("body: expected JSON")?;
    reader.end().context("body: expected one JSON value")?;
    Ok(value)
}

/// Reads a value with a limit on the number and the depth of all values.
struct Bounded<'a> {
    items: &'a mut usize,
    depth: usize,
}

impl<'de> DeserializeSeed<'de> for Bounded<'_> {
    type Value = Value<'static>;

    fn deserialize<D: Deserializer<'de>>(self, reader: D) -> Result<Value<'static>, D::Error> {
        *self.items += 1;
        if *self.items > ITEMS_MAX {
            return Err(D::Error::custom(format!("expected at most {ITEMS_MAX} values, got more")));
        }
        reader.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Bounded<'_> {
    type Value = Value<'static>;

    fn expecting(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("a JSON value")
    }

    fn visit_unit<E: Error>(self) -> Result<Value<'static>, E> {
        Ok(Value::Nil)
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Value<'static>, E> {
        Ok(Value::Bool(value))
    }

    fn visit_u64<E: Error>(self, number: u64) -> Result<Value<'static>, E> {
        Ok(Value::Integer(number.into()))
    }

    fn visit_i64<E: Error>(self, number: i64) -> Result<Value<'static>, E> {
        Ok(Value::Integer(number.into()))
    }

    fn visit_f64<E: Error>(self, number: f64) -> Result<Value<'static>, E> {
        Ok(Value::Float(number))
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Value<'static>, E> {
        Ok(Value::Text(Cow::Owned(text.to_owned())))
    }

    fn visit_string<E: Error>(self, text: String) -> Result<Value<'static>, E> {
        Ok(Value::Text(Cow::Owned(text)))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut access: A) -> Result<Value<'static>, A::Error> {
        let depth = self.deeper::<A::Error>()?;
        let mut values = Vec::new();
        while let Some(value) =
            access.next_element_seed(Bounded { items: &mut *self.items, depth })?
        {
            values.push(value);
        }
        Ok(Value::List(values))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<Value<'static>, A::Error> {
        let depth = self.deeper::<A::Error>()?;
        let mut entries: Vec<(Key<'static>, Value<'static>)> = Vec::new();
        let mut names = std::collections::HashSet::new();
        while let Some(name) = access.next_key::<String>()? {
            if !names.insert(name.clone()) {
                return Err(A::Error::custom("expected every key once"));
            }
            let value = access.next_value_seed(Bounded { items: &mut *self.items, depth })?;
            entries.push((Key { name: Cow::Owned(name), form: super::KeyForm::Text }, value));
        }
        Ok(Value::Map(entries))
    }
}

impl Bounded<'_> {
    fn deeper<E: Error>(&self) -> Result<usize, E> {
        if self.depth < DEPTH_MAX {
            return Ok(self.depth + 1);
        }
        Err(E::custom(format!("expected at most {DEPTH_MAX} nested values, got more")))
    }
}
