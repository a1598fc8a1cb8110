//! A newly trained verifier, published for agents.

use bytes::Bytes;
use serde::{Deserialize, Serialize};

use super::value;
use crate::codec::Message;
use crate::limits::VERIFIER_UPDATE_BYTES_MAX;

/// zenoh keeps the last update of each name for later subscribers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VerifierUpdate {
    /// The verifier's name, as in its key.
    pub name: String,
    /// SHA-256 of the weights, in hexadecimal.
    pub digest: String,
    /// Digest of the policy whose hidden states the verifier reads; an agent with another policy
    /// ignores the update.
    pub policy: String,
    /// The verifier as a safetensors file.
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
