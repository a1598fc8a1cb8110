//! Version, commit and date of this build, and the command line of this process.

use serde_json::{Value, json};
use store::provenance::Build;
use store::record::Versions;

/// The build of this program.
pub fn build() -> Build {
    Build::new(env!("CARGO_PKG_VERSION"), env!("REVER_COMMIT"), env!("REVER_BUILD_DATE"))
}

/// The command line of this process, one entry per argument.
pub fn command_line() -> Vec<String> {
    std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect()
}

/// The versions that results depend on and that are known before a run starts.
pub fn versions(policy: &str, verifier: Option<&str>) -> Value {
    json!({
        "rever": env!("CARGO_PKG_VERSION"),
        "protocol": protocol::PROTOCOL_VERSION,
        "policy": policy,
        "verifier": verifier,
    })
}

/// The versions for the records of this build. Simulator, policy and verifier are filled in for each episode.
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
