//! Bytes of the three wires, strict and bounded: a decoder never allocates more than a small
//! multiple of the bytes that came, and names what was expected and what came.

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
