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

pub use decision::{DecisionBench, Report};
pub use observations::read as read_observations;
pub use simulators::SimulatorsBench;
pub use throughput::ThroughputBench;
pub use torch::Torch;
pub use wire::WireBench;
