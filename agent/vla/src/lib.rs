//! A policy from a local checkpoint in the OpenVLA/Prismatic layout: from an image and an
//! instruction to candidates with reasoning and action.
//!
//! ```text
//! image ─▶ pixels ─▶ vision ─▶ projector ─┐
//! instruction ─▶ prompt ──────────────────┴▶ decoder.prefill ─▶ shared prefix ─┐
//!                                            decoder.step x N candidates ◀─────┘─▶ sampling
//! tokens ─▶ candidate (reasoning, actions) or a reason why it is malformed
//! ```
//!
//! Weights are immutable; caches are passed as values. The result for a request does not depend on
//! the other requests of the batch.

// The checkpoint as a policy or as a verifier's backbone, and what it is compared with.
mod backbone;
mod parity;
mod policy;

// The checkpoint's files: configuration, tokenizer, prompt, reasoning, action bins, weights.
mod checkpoint;

// The network from the outside in, and its kernels.
mod kernels;
mod network;

// Token generation: the decode loop, sampling, timing.
mod generate;

pub use backbone::BackbonePolicy;
pub use checkpoint::completion::CompletionParser;
pub use checkpoint::options::{LoadOptions, ReasoningMode};
pub use checkpoint::weights::Loaded;
pub use generate::timings::Timings;
pub use kernels::backend::Backend;
pub use kernels::device::DeviceName;
pub use kernels::matmul::WeightFormat;
pub use parity::GreedyTrace;
pub use policy::{Loading, Vla};

#[cfg(test)]
mod tests;
