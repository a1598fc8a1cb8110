//! Messages to bytes and back, strictly: a body is read only when every byte of it is meant.
//!
//! Reading goes: size limit → structure of the raw bytes → types → shape → values. The shape: the message, written
//! again, must have the one that came; this refuses what serde would let pass (a struct sent as an
//! array, an integer for a float, text for bytes, a missing optional field). The order of a map's entries is free.

use std::borrow::Cow;
use std::ops::Range;

use bytes::Bytes;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::structure::{self, Bulk};

/// A value of bytes that holds none, written.
const NO_BYTES: &[u8] = &[0xc4, 0];

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

    /// The one value of bytes that may be large, such as a picture: what it holds has no part in the message's shape.
    fn bulk(&mut self) -> Option<&mut Bytes> {
        None
    }

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
    valid(parse(bytes)?)
}

/// Reads a message out of exactly `bytes` and leaves its bulk where it lies there.
pub fn decode_shared<M: Message>(bytes: &Bytes) -> Result<M, CodecError> {
    valid(read(bytes, |content| bytes.slice(content))?)
}

/// Reads a message whose values may be out of bounds, with what is wrong with them: a server must know which request
/// it refuses.
pub fn parse<M: Message>(bytes: &[u8]) -> Result<(M, Option<CodecError>), CodecError> {
    read(bytes, |content| Bytes::copy_from_slice(&bytes[content]))
}

/// Parses `bytes` without their bulk, which `bulk_at` makes of its place: nothing large is copied on the way.
fn read<M: Message>(
    bytes: &[u8],
    bulk_at: impl FnOnce(Range<usize>) -> Bytes,
) -> Result<(M, Option<CodecError>), CodecError> {
    check_size::<M>(bytes.len())?;
    let malformed = |reason| CodecError::Malformed { message: M::NAME, reason };
    let came = structure::check(bytes).map_err(malformed)?;
    M::recognise(bytes).map_err(|reason| CodecError::Invalid { message: M::NAME, reason })?;
    let without =
        |bulk: &Bulk| [&bytes[..bulk.start], NO_BYTES, &bytes[bulk.content.end..]].concat();
    let rest = came.bulk.as_ref().map_or(Cow::Borrowed(bytes), |bulk| Cow::Owned(without(bulk)));
    let mut message: M = rmp_serde::from_slice(&rest).map_err(|error| malformed(words(error)))?;
    let meant = shape(&message).map_err(malformed)?;
    if came.shape != meant {
        return Err(malformed(format!("expected the shape {meant}, got {}", came.shape)));
    }
    if let (Some(place), Some(bulk)) = (message.bulk(), came.bulk) {
        *place = bulk_at(bulk.content);
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

fn valid<M>((message, invalid): (M, Option<CodecError>)) -> Result<M, CodecError> {
    invalid.map_or(Ok(message), Err)
}

/// serde's own sentence without the wrapping of the format.
fn words(error: rmp_serde::decode::Error) -> String {
    match error {
        rmp_serde::decode::Error::Syntax(reason) => reason,
        other => other.to_string(),
    }
}

/// The shape of `message` as it is written.
fn shape<M: Message>(message: &M) -> Result<structure::Shape, String> {
    let written = rmp_serde::to_vec_named(message).map_err(|error| error.to_string())?;
    Ok(structure::check(&written)?.shape)
}
