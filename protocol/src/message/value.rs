//! Checks of single values, worded once for every message.

use crate::codec::first_value;
use crate::limits::{ELEMENTS_MAX, NAME_BYTES_MAX, TEXT_BYTES_MAX};
use crate::{PROTOCOL_VERSION, limits};

/// A name: not empty, not long, and harmless in a terminal.
pub fn name(field: &str, value: &str) -> Result<(), String> {
    if value.is_empty() || value.len() > NAME_BYTES_MAX {
        return Err(format!("{field}: expected 1 to {NAME_BYTES_MAX} bytes, got {}", value.len()));
    }
    if let Some(letter) = value.chars().find(|letter| letter.is_control()) {
        return Err(format!(
            "{field}: expected no control characters, got U+{:04X}",
            letter as u32
        ));
    }
    Ok(())
}

/// A text: not long.
pub fn text(field: &str, value: &str) -> Result<(), String> {
    if value.len() > TEXT_BYTES_MAX {
        return Err(format!(
            "{field}: expected at most {TEXT_BYTES_MAX} bytes, got {}",
            value.len()
        ));
    }
    Ok(())
}

/// A list that a peer may loop over.
pub fn elements(field: &str, length: usize) -> Result<(), String> {
    if length > ELEMENTS_MAX {
        return Err(format!("{field}: expected at most {ELEMENTS_MAX} elements, got {length}"));
    }
    Ok(())
}

/// A list of so many numbers.
pub fn length(field: &str, length: usize, low: usize, high: usize) -> Result<(), String> {
    if !(low..=high).contains(&length) {
        return Err(format!("{field}: expected {low} to {high} numbers, got {length}"));
    }
    Ok(())
}

/// Numbers without NaN and infinity.
pub fn finite(field: &str, values: &[f32]) -> Result<(), String> {
    match values.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(index) => Err(format!(
            "{field}: expected finite numbers, got {} at index {index}",
            words(values[index])
        )),
    }
}

/// A number above zero.
pub fn positive(field: &str, value: f32) -> Result<(), String> {
    finite(field, &[value])?;
    if value <= 0.0 {
        return Err(format!("{field}: expected a number above 0, got {value}"));
    }
    Ok(())
}

/// A whole number in a range.
pub fn range(field: &str, value: u64, low: u64, high: u64) -> Result<(), String> {
    if !(low..=high).contains(&value) {
        return Err(format!("{field}: expected {low} to {high}, got {value}"));
    }
    Ok(())
}

/// Both sides are 0 when no image is wanted.
pub fn image_sides(fields: [&str; 2], height: u64, width: u64) -> Result<(), String> {
    if (height, width) == (0, 0) {
        return Ok(());
    }
    range(fields[0], height, 1, limits::IMAGE_SIDE_MAX as u64)?;
    range(fields[1], width, 1, limits::IMAGE_SIDE_MAX as u64)
}

/// A request's number; 0 stands in a reply to a request that could not be read.
pub fn sequence(value: u64, low: u64) -> Result<(), String> {
    range("sequence", value, low, limits::SEED_END - 1)
}

/// The version of the peer.
pub fn protocol(version: u32) -> Result<(), String> {
    if version != PROTOCOL_VERSION {
        return Err(format!("expected protocol {PROTOCOL_VERSION}, got protocol {version}"));
    }
    Ok(())
}

/// The version of a peer whose message may have other fields than ours.
pub fn recognise_protocol(bytes: &[u8]) -> Result<(), String> {
    #[derive(serde::Deserialize)]
    struct Versioned {
        protocol: u32,
    }
    match first_value::<Versioned>(bytes) {
        Ok((versioned, _)) => protocol(versioned.protocol),
        // Not even a version: the strict decoder has better words for it.
        Err(_) => Ok(()),
    }
}

fn words(value: f32) -> &'static str {
    match value {
        value if value.is_nan() => "nan",
        value if value > 0.0 => "inf",
        _ => "-inf",
    }
}
