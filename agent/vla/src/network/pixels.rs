//! Image preprocessing for the vision towers: normalisation and patches.

use protocol::message::Image;

/// Mean and standard deviation of each colour channel, for values in 0..1.
pub struct Normalisation {
    pub mean: [f32; 3],
    pub deviation: [f32; 3],
}

/// ImageNet's values, for DINO-like towers.
pub const DINO: Normalisation =
    Normalisation { mean: [0.485, 0.456, 0.406], deviation: [0.229, 0.224, 0.225] };

/// The values for all other towers.
pub const SIGLIP: Normalisation = Normalisation { mean: [0.5; 3], deviation: [0.5; 3] };

/// (images x side x side, 3 x patch x patch): each patch channel by channel, in the layout of
/// convolution weights.
pub fn patch_rows(
    images: &[&Image],
    side: usize,
    patch: usize,
    normalisation: &Normalisation,
) -> Vec<f32> {
    // (colour, byte) -> normalised number
    let table: [[f32; 256]; 3] = std::array::from_fn(|colour| {
        std::array::from_fn(|byte| {
            let value = byte as f32 / 255.0;
            (value - normalisation.mean[colour]) / normalisation.deviation[colour]
        })
    });
    let mut rows = Vec::with_capacity(images.len() * side * side * 3 * patch * patch);
    for image in images {
        assert_eq!((image.height, image.width), (side * patch, side * patch), "image size");
        for tile in 0..side * side {
            let (top, left) = (tile / side * patch, tile % side * patch);
            for (colour, table) in table.iter().enumerate() {
                for y in top..top + patch {
                    let start = (y * image.width + left) * 3;
                    let line = &image.pixels[start..start + 3 * patch];
                    rows.extend(
                        line.iter().skip(colour).step_by(3).map(|&b| table[usize::from(b)]),
                    );
                }
            }
        }
    }
    rows
}
