//! Bytes of the three wires, strict and bounded: a decoder allocates in proportion to the bytes
//! received, never to an announced length, and names what it expected and what it received.

mod actions;
mod array;
pub mod extension;
mod image;
pub mod json_numpy;
pub mod openpi;
mod read;
mod value;
pub mod vla_eval;
mod write;

pub use actions::{DIMENSIONS_MAX, STEPS_MAX, actions_array, actions_of};
pub use array::{Array, Dtype};
pub use image::{IMAGE_SIDE_MAX, ImageForm, decode_image, image_value};
pub use read::{DEPTH_MAX, FRAME_BYTES_MAX, ITEMS_MAX, decode};
pub use value::{Key, KeyForm, Value, printable};
pub use write::encode;

#[cfg(test)]
pub(crate) mod tests;
