//! Sample, verify, act: an agent that thinks aloud several times per step and executes the candidate that a verifier picks.
//!
//! One control step is four calls, and what comes of an episode flows back as labels:
//!
//! ```text
//! wire::environment ─▶ policy.propose(N) ─▶ verifier.logits ─▶ strategy.choose ─▶ environment.step
//!                                                                                      │ outcome
//! verifier ◀─ training ◀─ labels ◀─ wire::outcomes ◀──────────────── run ◀─ record ◀───┘
//! ```
//!
//! An outcome is data; a fault is an `Err` and never becomes a label. The modules in reading order:

// The network that proposes candidates.
pub mod policy;

// The environment servers, over zenoh.
pub mod wire;

// The loop: propose, score, choose, step.
pub mod rollout;

// What is to be run, and how a candidate is chosen.
pub mod strategy;
pub mod suite;

// What is kept, and what is computed from it.
pub mod calibration;
pub mod labels;
pub mod progress;
pub mod record;
pub mod result_file;
pub mod results;
pub mod run;
pub mod statistics;
pub mod table;
pub mod training;
pub mod verifier;

// All of it together.
pub mod campaign;
pub mod collector;
pub mod site;
pub mod stop;

// Servers on this machine, videos of what they showed, the page of a run.
pub mod report;
pub mod servers;
pub mod setup;
pub mod simulator;
pub mod video;

// What it costs, and whether a server keeps to the protocol.
pub mod bench;
pub mod conformance;

// The program's subcommands.
pub mod command;
