//! A MessagePack value that borrows text and bytes from its frame.

use std::borrow::Cow;

use anyhow::{Result, bail};

/// Maximum length of a peer's text in an error message.
const QUOTED_CHARS_MAX: usize = 300;

/// One value of a frame.
#[derive(Debug, Clone, PartialEq)]
pub enum Value<'a> {
    /// No value.
    Nil,
    /// True or false.
    Bool(bool),
    /// From -2^63 to 2^64 - 1.
    Integer(i128),
    /// 32-bit floats are widened.
    Float(f64),
    /// Text.
    Text(Cow<'a, str>),
    /// Raw bytes.
    Bytes(Cow<'a, [u8]>),
    /// An array of values.
    List(Vec<Value<'a>>),
    /// Entries in the order of the frame; no key occurs twice.
    Map(Vec<(Key<'a>, Value<'a>)>),
}

/// The key of a map's entry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Key<'a> {
    /// The name.
    pub name: Cow<'a, str>,
    /// How the name is encoded.
    pub form: KeyForm,
}

/// How the keys of a map are encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KeyForm {
    /// As text: JSON-like maps, and arrays in vla-eval.
    Text,
    /// As bytes: arrays in openpi.
    Bytes,
}

impl<'a> Value<'a> {
    /// Text without a copy.
    pub fn text(text: &'a str) -> Value<'a> {
        Value::Text(Cow::Borrowed(text))
    }

    /// A map with text keys.
    pub fn map(entries: impl IntoIterator<Item = (&'a str, Value<'a>)>) -> Value<'a> {
        let entries = entries.into_iter().map(|(name, value)| (Key::text(name), value));
        Value::Map(entries.collect())
    }

    /// What it is, for messages.
    pub fn kind(&self) -> &'static str {
        match self {
            Value::Nil => "nil",
            Value::Bool(_) => "a boolean",
            Value::Integer(_) => "an integer",
            Value::Float(_) => "a float",
            Value::Text(_) => "text",
            Value::Bytes(_) => "bytes",
            Value::List(_) => "a list",
            Value::Map(_) => "a map",
        }
    }

    /// The entries of a map.
    pub fn entries(&self) -> Result<&[(Key<'a>, Value<'a>)]> {
        match self {
            Value::Map(entries) => Ok(entries),
            other => bail!("expected a map, got {}", other.kind()),
        }
    }

    /// The value of a key; `None` if this is no map or has no such key.
    pub fn get(&self, name: &str) -> Option<&Value<'a>> {
        let Value::Map(entries) = self else { return None };
        entries.iter().find(|(key, _)| key.name == name).map(|(_, value)| value)
    }

    /// The value of a key that must exist.
    pub fn field(&self, name: &str) -> Result<&Value<'a>> {
        self.entries()?;
        match self.get(name) {
            Some(value) => Ok(value),
            None => bail!("expected the key {name:?}, got {}", self.key_names()),
        }
    }

    /// Text.
    pub fn as_text(&self) -> Result<&str> {
        match self {
            Value::Text(text) => Ok(text),
            other => bail!("expected text, got {}", other.kind()),
        }
    }

    /// An integer in the range of `T`.
    pub fn as_integer<T: TryFrom<i128>>(&self) -> Result<T> {
        let Value::Integer(integer) = self else {
            bail!("expected an integer, got {}", self.kind());
        };
        match T::try_from(*integer) {
            Ok(number) => Ok(number),
            Err(_) => bail!("expected an integer in range, got {integer}"),
        }
    }

    /// An integer or a float.
    pub fn as_number(&self) -> Result<f64> {
        match self {
            Value::Integer(integer) => Ok(*integer as f64),
            Value::Float(float) => Ok(*float),
            other => bail!("expected a number, got {}", other.kind()),
        }
    }

    /// The keys of a map, for messages.
    pub fn key_names(&self) -> String {
        let Value::Map(entries) = self else { return self.kind().to_owned() };
        if entries.is_empty() {
            return "an empty map".to_owned();
        }
        let names: Vec<&str> = entries.iter().map(|(key, _)| &*key.name).collect();
        printable(&names.join(", "))
    }
}

impl<'a> Key<'a> {
    /// A text key.
    pub fn text(name: &'a str) -> Key<'a> {
        Key { name: Cow::Borrowed(name), form: KeyForm::Text }
    }
}

/// A peer's text, shortened and without control characters, for terminals, logs and pages.
pub fn printable(text: &str) -> String {
    let replace = |letter: char| if letter.is_control() { '\u{fffd}' } else { letter };
    let mut shown: String = text.trim().chars().take(QUOTED_CHARS_MAX).map(replace).collect();
    if text.trim().chars().nth(QUOTED_CHARS_MAX).is_some() {
        shown.push('…');
    }
    shown
}
