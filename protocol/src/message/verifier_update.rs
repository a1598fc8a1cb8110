//! A newly trained verifier on its way to the agents.

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use super::value;
use crate::codec::Message;
use crate::limits::VERIFIER_UPDATE_BYTES_MAX;

/// The last one of each name is kept for those who come later.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VerifierUpdate {
    /// The verifier's name, as in its key.
    pub name: String,
    /// SHA-256 of the weights, in hexadecimal.
    pub digest: String,
    /// Digest of the policy whose hidden states it reads; agents with another policy ignore it.
    pub policy: String,
    /// A safetensors file.
    pub weights: Bytes,
}

impl Message for VerifierUpdate {
    const NAME: &'static str = "verifier update";
    const BYTES_MAX: usize = VERIFIER_UPDATE_BYTES_MAX;

    fn validate(&self) -> Result<(), String> {
        value::name("name", &self.name)?;
        value::name("digest", &self.digest)?;
        value::name("policy", &self.policy)
    }
}
