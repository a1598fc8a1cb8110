//! Token generation: the decode loop, sampling, timing.

pub mod decode_loop;
pub mod sampling;
pub mod timings;
pub mod worker_pools;
