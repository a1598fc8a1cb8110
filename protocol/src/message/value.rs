//! Checks of single values, so that all messages report the same errors.

use crate::codec::first_value;
use crate::limits::{ELEMENTS_MAX, NAME_BYTES_MAX, TEXT_BYTES_MAX};
use crate::{PROTOCOL_VERSION, limits};

/// A name is not empty, has a limited length and contains no control characters, which could change
/// a terminal.
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

/// A text has a limited length.
pub fn text(field: &str, value: &str) -> Result<(), String> {
    if value.len() > TEXT_BYTES_MAX {
        return Err(format!(
            "{field}: expected at most {TEXT_BYTES_MAX} bytes, got {}",
            value.len()
        ));
    }
    Ok(())
}

/// A list has a limited length, because a peer loops over it.
pub fn elements(field: &str, length: usize) -> Result<(), String> {
    if length > ELEMENTS_MAX {
        return Err(format!("{field}: expected at most {ELEMENTS_MAX} elements, got {length}"));
    }
    Ok(())
}

/// A list of numbers has a length within these bounds.
pub fn length(field: &str, length: usize, low: usize, high: usize) -> Result<(), String> {
    if !(low..=high).contains(&length) {
        return Err(format!("{field}: expected {low} to {high} numbers, got {length}"));
    }
    Ok(())
}

/// No number is NaN or infinite.
pub fn finite(field: &str, values: &[f32]) -> Result<(), String> {
    match values.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(index) => Err(format!(
            "{field}: expected finite numbers, got {} at index {index}",
            words(values[index])
        )),
    }
}

/// The number is finite and above 0.
pub fn positive(field: &str, value: f32) -> Result<(), String> {
    finite(field, &[value])?;
    if value <= 0.0 {
        return Err(format!("{field}: expected a number above 0, got {value}"));
    }
    Ok(())
}

/// The whole number is in this range.
pub fn range(field: &str, value: u64, low: u64, high: u64) -> Result<(), String> {
    if !(low..=high).contains(&value) {
        return Err(format!("{field}: expected {low} to {high}, got {value}"));
    }
    Ok(())
}

/// Both sides are 0 if no image is wanted; otherwise both are within the limit.
pub fn image_sides(fields: [&str; 2], height: u64, width: u64) -> Result<(), String> {
    if (height, width) == (0, 0) {
        return Ok(());
    }
    range(fields[0], height, 1, limits::IMAGE_SIDE_MAX as u64)?;
    range(fields[1], width, 1, limits::IMAGE_SIDE_MAX as u64)
}

/// The number of a request; 0 occurs only in a reply to a request that could not be decoded.
pub fn sequence(value: u64, low: u64) -> Result<(), String> {
    range("sequence", value, low, limits::SEED_END - 1)
}

/// The peer uses the same version of the protocol.
pub fn protocol(version: u32) -> Result<(), String> {
    if version != PROTOCOL_VERSION {
        return Err(format!("expected protocol {PROTOCOL_VERSION}, got protocol {version}"));
    }
    Ok(())
}

/// Checks the version of a peer whose message may have other fields than ours.
pub fn recognise_protocol(bytes: &[u8]) -> Result<(), String> {
    #[derive(serde::Deserialize)]
    struct Versioned {
        protocol: u32,
    }
    match first_value::<Versioned>(bytes) {
        Ok((versioned, _)) => protocol(versioned.protocol),
        // There is no version to read: the strict decoder reports what is wrong.
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
