//! Which build of the program this is.

use serde_json::{Value, json};
use store::provenance::Build;
use store::record::Versions;

/// The build of this program.
pub fn build() -> Build {
    Build::new(env!("CARGO_PKG_VERSION"), env!("REVER_COMMIT"), env!("REVER_BUILD_DATE"))
}

/// How this program was called, word by word.
pub fn command_line() -> Vec<String> {
    std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect()
}

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
        commit: build().commit_text(),
        protocol: protocol::PROTOCOL_VERSION,
        simulator: String::new(),
        policy: String::new(),
        verifier: None,
    }
}
