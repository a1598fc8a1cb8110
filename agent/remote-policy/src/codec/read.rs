//! Reads one MessagePack value that must fill its frame.

use std::borrow::Cow;

use anyhow::{Result, anyhow, bail, ensure};
use rmp::Marker;

use super::{Key, KeyForm, Value};

/// Maximum size of a frame. Three uncompressed images of 640 x 480 pixels have 2.8 MB; 256
/// candidates with hidden states of 4096 numbers have 4 MB.
pub const FRAME_BYTES_MAX: usize = 32 * 1024 * 1024;
/// Maximum depth of nested lists and maps.
pub const DEPTH_MAX: usize = 16;
/// Maximum number of values in a frame. Arrays of numbers are bytes, so a frame has few values.
pub const ITEMS_MAX: usize = 1 << 16;

/// Decodes a frame. Bytes and text are borrowed from it.
pub fn decode(frame: &[u8]) -> Result<Value<'_>> {
    let bytes = frame.len();
    ensure!(
        bytes <= FRAME_BYTES_MAX,
        "frame: expected at most {FRAME_BYTES_MAX} bytes, got {bytes}"
    );
    let mut reader = Reader { rest: frame, items: 0 };
    let value = reader.value(0)?;
    let more = reader.rest.len();
    ensure!(
        more == 0,
        "frame: expected the end after byte {}, got {more} more bytes",
        bytes - more
    );
    Ok(value)
}

struct Reader<'a> {
    rest: &'a [u8],
    /// Number of values so far.
    items: usize,
}

impl<'a> Reader<'a> {
    fn value(&mut self, depth: usize) -> Result<Value<'a>> {
        self.items += 1;
        ensure!(self.items <= ITEMS_MAX, "frame: expected at most {ITEMS_MAX} values, got more");
        let [marker] = self.array()?;
        Ok(match Marker::from_u8(marker) {
            Marker::Null => Value::Nil,
            Marker::True => Value::Bool(true),
            Marker::False => Value::Bool(false),
            Marker::FixPos(number) => Value::Integer(number.into()),
            Marker::FixNeg(number) => Value::Integer(number.into()),
            Marker::U8 => Value::Integer(u8::from_be_bytes(self.array()?).into()),
            Marker::U16 => Value::Integer(u16::from_be_bytes(self.array()?).into()),
            Marker::U32 => Value::Integer(u32::from_be_bytes(self.array()?).into()),
            Marker::U64 => Value::Integer(u64::from_be_bytes(self.array()?).into()),
            Marker::I8 => Value::Integer(i8::from_be_bytes(self.array()?).into()),
            Marker::I16 => Value::Integer(i16::from_be_bytes(self.array()?).into()),
            Marker::I32 => Value::Integer(i32::from_be_bytes(self.array()?).into()),
            Marker::I64 => Value::Integer(i64::from_be_bytes(self.array()?).into()),
            Marker::F32 => Value::Float(f32::from_be_bytes(self.array()?).into()),
            Marker::F64 => Value::Float(f64::from_be_bytes(self.array()?)),
            Marker::FixStr(length) => self.text(length.into())?,
            Marker::Str8 => self.sized::<1>(Self::text)?,
            Marker::Str16 => self.sized::<2>(Self::text)?,
            Marker::Str32 => self.sized::<4>(Self::text)?,
            Marker::Bin8 => self.sized::<1>(Self::bytes)?,
            Marker::Bin16 => self.sized::<2>(Self::bytes)?,
            Marker::Bin32 => self.sized::<4>(Self::bytes)?,
            Marker::FixArray(length) => self.list(length.into(), depth)?,
            Marker::Array16 => self.sized::<2>(|reader, length| reader.list(length, depth))?,
            Marker::Array32 => self.sized::<4>(|reader, length| reader.list(length, depth))?,
            Marker::FixMap(length) => self.map(length.into(), depth)?,
            Marker::Map16 => self.sized::<2>(|reader, length| reader.map(length, depth))?,
            Marker::Map32 => self.sized::<4>(|reader, length| reader.map(length, depth))?,
            other => bail!("frame: expected no extension type, got {other:?}"),
        })
    }

    fn sized<const N: usize>(
        &mut self,
        read: impl FnOnce(&mut Self, usize) -> Result<Value<'a>>,
    ) -> Result<Value<'a>> {
        let bytes: [u8; N] = self.array()?;
        let length = bytes.iter().fold(0, |length, byte| length << 8 | usize::from(*byte));
        read(self, length)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N]> {
        let bytes = self.slice(N)?;
        bytes.try_into().map_err(|_| anyhow!("frame: expected {N} bytes"))
    }

    fn slice(&mut self, length: usize) -> Result<&'a [u8]> {
        match self.rest.split_at_checked(length) {
            Some((slice, rest)) => {
                self.rest = rest;
                Ok(slice)
            }
            None => bail!("frame: expected {length} more bytes, got {}", self.rest.len()),
        }
    }

    fn bytes(&mut self, length: usize) -> Result<Value<'a>> {
        Ok(Value::Bytes(Cow::Borrowed(self.slice(length)?)))
    }

    fn text(&mut self, length: usize) -> Result<Value<'a>> {
        match std::str::from_utf8(self.slice(length)?) {
            Ok(text) => Ok(Value::Text(Cow::Borrowed(text))),
            Err(_) => bail!("frame: expected text in UTF-8, got other bytes"),
        }
    }

    fn list(&mut self, length: usize, depth: usize) -> Result<Value<'a>> {
        self.check_length(length, depth)?;
        let values = (0..length).map(|_| self.value(depth + 1));
        Ok(Value::List(values.collect::<Result<_>>()?))
    }

    fn map(&mut self, length: usize, depth: usize) -> Result<Value<'a>> {
        self.check_length(length, depth)?;
        // Not reserved: every level of nested maps may announce as many entries as there are bytes.
        let mut entries = Vec::new();
        for _ in 0..length {
            entries.push((self.key()?, self.value(depth + 1)?));
        }
        let mut names: Vec<&str> =
            entries.iter().map(|(key, _): &(Key<'_>, _)| &*key.name).collect();
        names.sort_unstable();
        if let Some(pair) = names.windows(2).find(|pair| pair[0] == pair[1]) {
            bail!("frame: expected every key once, got {:?} twice", super::printable(pair[0]));
        }
        Ok(Value::Map(entries))
    }

    /// An announced length is believed only as far as there are bytes for it.
    fn check_length(&self, length: usize, depth: usize) -> Result<()> {
        ensure!(depth < DEPTH_MAX, "frame: expected at most {DEPTH_MAX} nested values, got more");
        let (left, room) = (self.rest.len(), ITEMS_MAX.saturating_sub(self.items));
        ensure!(length <= left, "frame: expected {length} more values, got {left} more bytes");
        ensure!(length <= room, "frame: expected at most {ITEMS_MAX} values, got more");
        Ok(())
    }

    fn key(&mut self) -> Result<Key<'a>> {
        match self.value(DEPTH_MAX)? {
            Value::Text(name) => Ok(Key { name, form: KeyForm::Text }),
            Value::Bytes(Cow::Borrowed(bytes)) => match std::str::from_utf8(bytes) {
                Ok(name) => Ok(Key { name: Cow::Borrowed(name), form: KeyForm::Bytes }),
                Err(_) => bail!("frame: expected a key in UTF-8, got other bytes"),
            },
            other => bail!("frame: expected text or bytes as a key, got {}", other.kind()),
        }
    }
}
