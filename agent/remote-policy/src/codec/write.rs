//! Writes a value as MessagePack, in the shortest form of each number, as Python's msgpack does.

use anyhow::{Context, Result};
use rmp::encode::{self, ValueWriteError};

use super::{KeyForm, Value};

/// Encodes a value.
pub fn encode(value: &Value<'_>) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    write(&mut bytes, value)?;
    Ok(bytes)
}

fn write(out: &mut Vec<u8>, value: &Value<'_>) -> Result<()> {
    match value {
        Value::Nil => out.push(0xc0),
        Value::Bool(value) => out.push(if *value { 0xc3 } else { 0xc2 }),
        Value::Integer(integer) => write_integer(out, *integer)?,
        Value::Float(float) => written(encode::write_f64(out, *float))?,
        Value::Text(text) => written(encode::write_str(out, text))?,
        Value::Bytes(bytes) => written(encode::write_bin(out, bytes))?,
        Value::List(values) => {
            let length = u32::try_from(values.len()).context("list: too long")?;
            written(encode::write_array_len(out, length).map(drop))?;
            for value in values {
                write(out, value)?;
            }
        }
        Value::Map(entries) => {
            let length = u32::try_from(entries.len()).context("map: too long")?;
            written(encode::write_map_len(out, length).map(drop))?;
            for (key, value) in entries {
                match key.form {
                    KeyForm::Text => written(encode::write_str(out, &key.name))?,
                    KeyForm::Bytes => written(encode::write_bin(out, key.name.as_bytes()))?,
                }
                write(out, value)?;
            }
        }
    }
    Ok(())
}

fn write_integer(out: &mut Vec<u8>, integer: i128) -> Result<()> {
    if let Ok(unsigned) = u64::try_from(integer) {
        return written(encode::write_uint(out, unsigned).map(drop));
    }
    let signed = i64::try_from(integer).context("integer: expected at most 64 bits")?;
    written(encode::write_sint(out, signed).map(drop))
}

/// Writing to memory does not fail; `rmp` allows for writers that do.
fn written(result: Result<(), ValueWriteError>) -> Result<()> {
    result.map_err(|error| anyhow::anyhow!("cannot encode: {error}"))
}
