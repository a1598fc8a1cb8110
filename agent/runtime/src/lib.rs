//! The loop: rollouts over sessions of environment servers, and what is told of them.
//!
//! ```text
//! Experiment ─▶ Rollout ─▶ one worker per episode ─▶ DecisionBatcher ─▶ Decider
//!                 │              │
//!                 │              └─ SessionPool ─▶ Environment ─▶ Episode (wire: zenoh)
//!                 └─ sinks: records, labels, videos, outcomes, progress
//! ```

// One run from beginning to end.
pub mod experiment;
pub mod replay;
pub mod rollout;
pub mod stop;

// Sessions of environments, over zenoh.
pub mod fault;
pub mod session;
pub mod wire;

#[cfg(test)]
mod scripted;

// What is told of a run.
pub mod sinks;

// Servers on this machine.
pub mod servers;

#[cfg(test)]
mod tests {
    use store::record::Versions;

    /// What records of tests say they were made with.
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
