//! What the layers are made of: products, attention over segments, norms, activations, on a processor or a device.

pub mod activation;
pub mod backend;
pub mod device;
pub mod matmul;
pub mod norm;
pub mod segment;
pub mod tile;
