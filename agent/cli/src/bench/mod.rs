//! Benchmarks of decisions, episodes, the wire and simulators. Decisions are compared with the same weights in PyTorch.
//!
//! The variants in a comparison take alternate measurements, so that a machine that slows down affects all of them.

mod bandwidth;
mod decision;
mod observations;
mod policy_server;
mod simulators;
mod throughput;
mod torch;
mod wire;

pub use decision::{DecisionBench, NetworkRow, Report, Row as DecisionRow};
pub use observations::{read as read_observations, scaled};
pub use policy_server::{PolicyServerBench, Row as PolicyServerRow};
pub use simulators::{Row as SimulatorsRow, SimulatorsBench};
pub use throughput::{Row as ThroughputRow, ThroughputBench};
pub use torch::Torch;
pub use wire::{Row as WireRow, WireBench};
