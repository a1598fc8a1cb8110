//! Runs episodes: rollouts over sessions of environment servers, and sinks for their events.
//!
//! ```text
//! Experiment ─▶ Rollout ─▶ one worker per episode ─▶ DecisionBatcher ─▶ Decider
//!                 │              │
//!                 │              └─ SessionPool ─▶ Environment ─▶ Episode (wire: zenoh)
//!                 └─ sinks: records, labels, videos, outcomes, progress
//! ```

// One run from start to end.
pub mod experiment;
pub mod replay;
pub mod rollout;
pub mod stop;

// Sessions of environments over zenoh.
pub mod fault;
pub mod session;
pub mod wire;

#[cfg(test)]
mod scripted;

// Recording and reporting a run.
pub mod sinks;

// Environment servers on this machine.
pub mod servers;

#[cfg(test)]
mod tests {
    use store::record::Versions;

    /// The versions in the records of tests.
    pub fn versions() -> Versions {
        Versions {
            rever: "0.0.0".to_owned(),
            commit: String::new(),
            protocol: protocol::PROTOCOL_VERSION,
            simulator: String::new(),
            policy: String::new(),
            verifier: None,
        }
    }
}
