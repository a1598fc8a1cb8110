//! The network: vision towers, projector, decoder.

pub mod attention;
pub mod cache;
pub mod center_crop;
pub mod decoder;
pub mod forward;
pub mod linear;
pub mod pixels;
pub mod projector;
pub mod rotary;
pub mod trace;
pub mod vision;
