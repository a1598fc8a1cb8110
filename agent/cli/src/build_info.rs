//! Which build of the program this is.

use serde_json::{Value, json};
use store::record::Versions;

/// The commit that the program was built from, with `-dirty` where files differed from it.
pub const COMMIT: &str = env!("REVER_COMMIT");

/// Everything that results depend on and that is known before a run starts.
pub fn versions(policy: &str, verifier: Option<&str>) -> Value {
    json!({
        "rever": env!("CARGO_PKG_VERSION"),
        "protocol": protocol::PROTOCOL_VERSION,
        "policy": policy,
        "verifier": verifier,
    })
}

/// What the records of this build say; simulator, policy and verifier are filled in for each.
pub fn record_versions() -> Versions {
    Versions {
        rever: env!("CARGO_PKG_VERSION").to_owned(),
        protocol: protocol::PROTOCOL_VERSION,
        simulator: String::new(),
        policy: String::new(),
        verifier: None,
    }
}
