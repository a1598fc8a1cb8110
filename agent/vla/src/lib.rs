//! A local checkpoint in the OpenVLA/Prismatic layout as a policy: an image and an instruction in, candidates of
//! reasoning and action out.
//!
//! ```text
//! image ─▶ pixels ─▶ vision ─▶ projector ─┐
//! instruction ─▶ prompt ──────────────────┴▶ decoder.prefill ─▶ shared prefix ─┐
//!                                            decoder.step x N candidates ◀─────┘─▶ sampling
//! tokens ─▶ candidate (reasoning, actions) or what is malformed about it
//! ```
//!
//! Weights never change; caches are values passed in. What a request gets does not depend on the requests beside it.

// The checkpoint as a policy.
mod policy;

// What its files say: configuration, tokenizer, prompt, reasoning, action bins, weights.
mod checkpoint;

// The network, from the outside in, and the kernels that its layers are made of.
mod kernels;
mod network;

// Tokens: the decode loop, its draws, how long it takes.
mod generate;

pub use checkpoint::completion::CompletionParser;
pub use generate::timings::Timings;
pub use kernels::backend::Backend;
pub use kernels::device::DeviceName;
pub use policy::Vla;

#[cfg(test)]
mod tests;
