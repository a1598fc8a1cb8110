//! Tokens: the decode loop, its draws, how long it takes.

pub mod decode_loop;
pub mod sampling;
pub mod timings;
pub mod worker_pools;
