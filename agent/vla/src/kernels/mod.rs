//! The kernels of the layers: products, attention over segments, norms, activations, on CPU or GPU.

pub mod activation;
pub mod backend;
pub mod device;
pub mod matmul;
pub mod norm;
pub mod segment;
pub mod tile;
