//! Frames made by the peers' own packages (`tests/golden_frames.py`), frames to refuse, and frames
//! of a hostile peer.

mod golden;
pub mod hostile;
mod refused;

use super::{Array, KeyForm, Value};

/// The pixels of the golden images: 2 x 3 x 3.
pub const PIXELS: [u8; 18] =
    [0, 14, 28, 42, 56, 70, 84, 98, 112, 126, 140, 154, 168, 182, 196, 210, 224, 238];
/// The state of the golden observations.
pub const STATE: [f32; 8] = [0.25, -0.5, 0.125, 0.0, 0.0, 1.5, 0.0, 1.0];
/// The actions of the golden results.
pub const CHUNK: [[f32; 7]; 2] =
    [[0.5, 0.0, 0.0, 0.0, 0.0, 0.25, 1.0], [-0.5, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]];

/// A frame of the folder `golden`.
pub fn golden(name: &str) -> Vec<u8> {
    let path = format!("{}/golden/{name}", env!("CARGO_MANIFEST_DIR"));
    std::fs::read(&path).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// All frames of the folder `golden` whose names start and end with these words.
pub fn all_golden(start: &str, end: &str) -> Vec<(String, Vec<u8>)> {
    let folder = format!("{}/golden", env!("CARGO_MANIFEST_DIR"));
    let names = std::fs::read_dir(folder)
        .expect("the folder")
        .map(|entry| entry.expect("an entry").file_name().into_string().expect("a name in UTF-8"));
    let mut names: Vec<String> =
        names.filter(|name| name.starts_with(start) && name.ends_with(end)).collect();
    names.sort();
    assert!(!names.is_empty(), "no golden frames {start}*{end}");
    names.into_iter().map(|name| (name.clone(), golden(&name))).collect()
}

/// A state as an array.
pub fn state(form: KeyForm) -> Value<'static> {
    Array::of_f32(vec![STATE.len()], &STATE).expect("an array").into_value(form)
}
