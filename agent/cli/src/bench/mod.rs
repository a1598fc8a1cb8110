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
pub use observations::{Observation, read as read_observations};
pub use simulators::{Row as SimulatorsRow, SimulatorsBench};
pub use throughput::{Row as ThroughputRow, ThroughputBench};
pub use torch::Torch;
pub use wire::{Row as WireRow, WireBench};

/// The value below which a share of all values lies; NaN when there is none.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let last = sorted.len().saturating_sub(1);
    sorted.get((share * last as f64).round() as usize).copied().unwrap_or(f64::NAN)
}
