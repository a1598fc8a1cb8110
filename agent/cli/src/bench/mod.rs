//! What decisions and episodes cost on this machine, beside the same weights in PyTorch.
//!
//! The sides of a table are measured alternately: a machine that slows down slows all of them down.

mod bandwidth;
mod decision;
mod observations;
mod simulators;
mod throughput;
mod torch;
mod wire;

pub use decision::{DecisionBench, Report, Row as DecisionRow};
pub use observations::read as read_observations;
pub use simulators::{Row as SimulatorsRow, SimulatorsBench};
pub use throughput::{Row as ThroughputRow, ThroughputBench};
pub use torch::Torch;
pub use wire::{Row as WireRow, WireBench};
