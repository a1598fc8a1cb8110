//! What decisions and episodes cost on this machine, beside the same weights in PyTorch.
//!
//! Times of one table are taken in turns, so that a machine that slows down slows all of them down.

mod bandwidth;
mod decision;
mod observations;
mod simulators;
mod throughput;
mod torch;
mod wire;

pub use decision::{Comparison, DecisionBench, Report, Row, Setting};
pub use observations::read as read_observations;
pub use simulators::{Row as SimulatorsRow, SimulatorsBench};
pub use throughput::{Row as ThroughputRow, ThroughputBench};
pub use torch::Torch;
pub use wire::{Row as WireRow, WireBench};
