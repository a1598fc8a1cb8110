//! Strict encoding and decoding of messages: a decoder accepts a body only if it understands every
//! byte.
//!
//! Decoding checks the size limit, the version, the types, the end of the input and the values, in
//! this order. The types reject unknown, missing and repeated fields, and floats that do not have
//! 32 bits. The entries of a map may come in any order.

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::limits::DEPTH_MAX;

/// Why a message could not be encoded or decoded.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CodecError {
    /// The message exceeds its size limit; nothing was decoded.
    #[error("{message} has {bytes} bytes, limit {bytes_max}")]
    TooLarge {
        /// Which message.
        message: &'static str,
        /// Its size.
        bytes: usize,
        /// The limit.
        bytes_max: usize,
    },
    /// The bytes are not an encoding of this message.
    #[error("{message} cannot be read: {reason}")]
    Malformed {
        /// Which message.
        message: &'static str,
        /// What was expected and what was received.
        reason: String,
    },
    /// The message was decoded, but one of its values is out of bounds.
    #[error("{message} is invalid: {reason}")]
    Invalid {
        /// Which message.
        message: &'static str,
        /// What was expected and what was received.
        reason: String,
    },
}

/// A message of the protocol.
pub trait Message: Serialize + DeserializeOwned {
    /// Its name in errors.
    const NAME: &'static str;
    /// Limit on the encoded size.
    const BYTES_MAX: usize;

    /// Checks every value. The reason names the field, what was expected and what was received.
    fn validate(&self) -> Result<(), String>;

    /// Checks the raw bytes before they are decoded. A peer of another version is refused because
    /// of its version, not because of its fields.
    fn recognise(_bytes: &[u8]) -> Result<(), String> {
        Ok(())
    }
}

/// Encodes `message`. An invalid message is refused here and never reaches a peer.
pub fn encode<M: Message>(message: &M) -> Result<Vec<u8>, CodecError> {
    message.validate().map_err(|reason| CodecError::Invalid { message: M::NAME, reason })?;
    let bytes = rmp_serde::to_vec_named(message)
        .map_err(|error| CodecError::Malformed { message: M::NAME, reason: error.to_string() })?;
    check_size::<M>(bytes.len())?;
    Ok(bytes)
}

/// Decodes a message that must fill `bytes` exactly.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<M, CodecError> {
    let (message, invalid) = parse(bytes)?;
    invalid.map_or(Ok(message), Err)
}

/// Decodes a message and reports invalid values separately: a server needs the number of the
/// request that it refuses.
pub fn parse<M: Message>(bytes: &[u8]) -> Result<(M, Option<CodecError>), CodecError> {
    check_size::<M>(bytes.len())?;
    let malformed = |reason| CodecError::Malformed { message: M::NAME, reason };
    M::recognise(bytes).map_err(|reason| CodecError::Invalid { message: M::NAME, reason })?;
    let (message, end): (M, usize) = first_value(bytes).map_err(malformed)?;
    if end < bytes.len() {
        let more = bytes.len() - end;
        return Err(malformed(format!("expected the end after byte {end}, got {more} more bytes")));
    }
    let invalid = message.validate().err();
    Ok((message, invalid.map(|reason| CodecError::Invalid { message: M::NAME, reason })))
}

/// Checks the size alone, before the bytes are copied or decoded.
pub fn check_size<M: Message>(bytes: usize) -> Result<(), CodecError> {
    if bytes > M::BYTES_MAX {
        return Err(CodecError::TooLarge { message: M::NAME, bytes, bytes_max: M::BYTES_MAX });
    }
    Ok(())
}

/// Decodes the first value in `bytes`; also returns the offset where it ends.
pub(crate) fn first_value<T: DeserializeOwned>(bytes: &[u8]) -> Result<(T, usize), String> {
    let mut rest = bytes;
    let mut reader = rmp_serde::Deserializer::new(&mut rest);
    reader.set_max_depth(DEPTH_MAX);
    let value = T::deserialize(&mut reader).map_err(|error| match error {
        // serde's own message, without the prefix that rmp-serde adds.
        rmp_serde::decode::Error::Syntax(reason) => reason,
        other => other.to_string(),
    })?;
    Ok((value, bytes.len() - rest.len()))
}
