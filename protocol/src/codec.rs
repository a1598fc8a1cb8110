//! Messages to bytes and back, strictly: a body is read only when every byte of it is meant.
//!
//! Reading goes: size limit → version → types → end → values. The types refuse unknown, missing and repeated fields and
//! floats of other than 32 bits. The order of a map's entries is free.

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::limits::DEPTH_MAX;

/// Why a message was not written or not read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CodecError {
    /// Beyond the message's size limit; nothing was decoded.
    #[error("{message} has {bytes} bytes, limit {bytes_max}")]
    TooLarge {
        /// Which message.
        message: &'static str,
        /// Size that came.
        bytes: usize,
        /// Size that is allowed.
        bytes_max: usize,
    },
    /// The bytes are not this message.
    #[error("{message} cannot be read: {reason}")]
    Malformed {
        /// Which message.
        message: &'static str,
        /// What was expected and what came.
        reason: String,
    },
    /// The bytes are this message, but a value in it is out of bounds.
    #[error("{message} is invalid: {reason}")]
    Invalid {
        /// Which message.
        message: &'static str,
        /// What was expected and what came.
        reason: String,
    },
}

/// One of the protocol's messages.
pub trait Message: Serialize + DeserializeOwned {
    /// What errors call it.
    const NAME: &'static str;
    /// Limit on the encoded size.
    const BYTES_MAX: usize;

    /// Checks every value; the reason names the field, what was expected and what came.
    fn validate(&self) -> Result<(), String>;

    /// Looks at the raw bytes first, so that another version is refused for its version and not for its fields.
    fn recognise(_bytes: &[u8]) -> Result<(), String> {
        Ok(())
    }
}

/// Writes `message`; an invalid one is refused here, so that a peer never sees it.
pub fn encode<M: Message>(message: &M) -> Result<Vec<u8>, CodecError> {
    message.validate().map_err(|reason| CodecError::Invalid { message: M::NAME, reason })?;
    let bytes = rmp_serde::to_vec_named(message)
        .map_err(|error| CodecError::Malformed { message: M::NAME, reason: error.to_string() })?;
    check_size::<M>(bytes.len())?;
    Ok(bytes)
}

/// Reads a message out of exactly `bytes`.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<M, CodecError> {
    let (message, invalid) = parse(bytes)?;
    invalid.map_or(Ok(message), Err)
}

/// Reads a message whose values may be out of bounds, with what is wrong with them: a server must know which request
/// it refuses.
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

/// Refuses a message by its size alone, for those who hold bytes that they have not yet copied.
pub fn check_size<M: Message>(bytes: usize) -> Result<(), CodecError> {
    if bytes > M::BYTES_MAX {
        return Err(CodecError::TooLarge { message: M::NAME, bytes, bytes_max: M::BYTES_MAX });
    }
    Ok(())
}

/// The value with which `bytes` begin, and where it ends.
pub(crate) fn first_value<T: DeserializeOwned>(bytes: &[u8]) -> Result<(T, usize), String> {
    let mut rest = bytes;
    let mut reader = rmp_serde::Deserializer::new(&mut rest);
    reader.set_max_depth(DEPTH_MAX);
    let value = T::deserialize(&mut reader).map_err(|error| match error {
        // serde's own sentence without the wrapping of the format.
        rmp_serde::decode::Error::Syntax(reason) => reason,
        other => other.to_string(),
    })?;
    Ok((value, bytes.len() - rest.len()))
}
