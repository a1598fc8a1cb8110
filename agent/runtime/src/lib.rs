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
pub mod rollout;
pub mod stop;

// Sessions of environments, over zenoh.
pub mod fault;
pub mod session;
pub mod wire;

// What is told of a run.
pub mod sinks;

// Servers on this machine.
pub mod servers;
pub mod setup;
pub mod simulator;
pub mod site;
