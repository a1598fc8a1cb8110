//! Fits a client's image to the policy's size.

use anyhow::{Context, Result};
use decision::Image;
use image::RgbImage;
use image::imageops::{FilterType, resize};

/// The image in the policy's size (height, width): unchanged if it has that size, otherwise resized
/// with a Lanczos filter of radius 3 to exactly these sides, as OpenVLA's Bridge evaluation does. The
/// aspect ratio is not kept.
pub fn fit(image: Image, (height, width): (usize, usize)) -> Result<Image> {
    if (image.height, image.width) == (height, width) {
        return Ok(image);
    }
    // A policy without images.
    if height == 0 || width == 0 {
        return Ok(Image::default());
    }
    let pixels = image.pixels.to_vec();
    let source = RgbImage::from_raw(image.width as u32, image.height as u32, pixels)
        .context("image: expected height x width x 3 bytes")?;
    let resized = resize(&source, width as u32, height as u32, FilterType::Lanczos3);
    Ok(Image { height, width, pixels: resized.into_raw().into() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_of_another_size_is_resized_and_one_of_the_right_size_is_not_touched() {
        let pixels: Vec<u8> = (0..4 * 6 * 3).map(|index| index as u8).collect();
        let image = Image { height: 4, width: 6, pixels: pixels.into() };
        let same = fit(image.clone(), (4, 6)).expect("the same");
        assert_eq!(same.pixels, image.pixels);
        let other = fit(image, (3, 3)).expect("resized");
        assert_eq!((other.height, other.width, other.pixels.len()), (3, 3, 27));
        let grey = Image { height: 9, width: 5, pixels: vec![77; 9 * 5 * 3].into() };
        assert!(fit(grey, (4, 4)).expect("resized").pixels.iter().all(|pixel| *pixel == 77));
    }
}
