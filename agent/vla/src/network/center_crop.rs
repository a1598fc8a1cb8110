//! The centre crop of OpenVLA's evaluation on LIBERO, for checkpoints that were fine-tuned with random
//! crops: `tf.image.crop_and_resize` of the central 90 % of the area, back to the same size.

use protocol::message::Image;

/// Share of the area that is kept.
const AREA: f32 = 0.9;

/// The central part of an image, enlarged to the image's size. Bilinear, with the corners of both
/// grids aligned, as TensorFlow does it.
pub fn center_crop(image: &Image) -> Image {
    let (rows, columns) = (places(image.height), places(image.width));
    let value = |y: usize, x: usize, colour: usize| {
        f32::from(image.pixels[(y * image.width + x) * 3 + colour]) * (1.0 / 255.0)
    };
    let mut pixels = Vec::with_capacity(image.pixels.len());
    for row in &rows {
        for column in &columns {
            for colour in 0..3 {
                let across = |y: usize| {
                    let (left, right) =
                        (value(y, column.low, colour), value(y, column.high, colour));
                    left + (right - left) * column.share
                };
                let (top, bottom) = (across(row.low), across(row.high));
                let number = top + (bottom - top) * row.share;
                // TensorFlow's conversion from 0..1 to bytes: it truncates after adding a half.
                pixels.push((number.clamp(0.0, 1.0) * 255.5) as u8);
            }
        }
    }
    Image { height: image.height, width: image.width, pixels: pixels.into() }
}

/// Where a row or column of the result lies between two of the image.
struct Place {
    low: usize,
    high: usize,
    share: f32,
}

fn places(size: usize) -> Vec<Place> {
    let side = AREA.sqrt();
    let first = (1.0 - side) / 2.0;
    let last = first + side;
    let (span, steps) = (size.saturating_sub(1) as f32, size.saturating_sub(1).max(1) as f32);
    let step = (last - first) * span / steps;
    (0..size)
        .map(|index| {
            let place = first * span + index as f32 * step;
            let low = place.floor();
            Place { low: low as usize, high: place.ceil() as usize, share: place - low }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_of_one_colour_stays_as_it_is() {
        let image = Image { height: 5, width: 7, pixels: vec![200; 5 * 7 * 3].into() };
        assert_eq!(center_crop(&image), image);
    }

    #[test]
    fn the_centre_is_enlarged_as_tensorflow_does_it() {
        // Computed independently in NumPy with TensorFlow's formulas:
        // s = np.sqrt(np.float32(0.9)); p = (1 - s) / 2 * 3 + np.arange(4) * s
        // np.interp along both axes of pixels / 255, then (x * 255.5).astype(np.uint8)
        let red: Vec<u8> = (0..16).map(|index| (index * index) as u8).collect();
        let pixels: Vec<u8> = red.iter().flat_map(|&red| [red, 255 - red, 7]).collect();
        let cropped = center_crop(&Image { height: 4, width: 4, pixels: pixels.into() });
        let channel = |colour: usize| -> Vec<u8> {
            cropped.pixels.iter().skip(colour).step_by(3).copied().collect()
        };
        assert_eq!(channel(0), RED);
        assert_eq!(channel(1), GREEN);
        assert_eq!(channel(2), [7; 16]);
    }

    const RED: [u8; 16] = [1, 2, 6, 11, 17, 26, 37, 49, 64, 80, 98, 117, 139, 163, 188, 215];
    const GREEN: [u8; 16] =
        [254, 252, 249, 243, 237, 228, 218, 205, 191, 175, 157, 137, 115, 92, 67, 40];
}
