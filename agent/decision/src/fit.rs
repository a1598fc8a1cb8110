//! Fits an image to a policy's size.

use anyhow::{Context, Result};
use fast_image_resize::images::{Image as Pixels, ImageRef};
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer};
use protocol::message::Image;

/// The image in the policy's size (height, width): unchanged if it has that size, otherwise resized
/// with a Lanczos filter of radius 3 to exactly these sides, as OpenVLA's Bridge evaluation does. The
/// aspect ratio is not kept.
pub fn fit_image(image: Image, (height, width): (usize, usize)) -> Result<Image> {
    if (image.height, image.width) == (height, width) {
        return Ok(image);
    }
    // A policy without images.
    if height == 0 || width == 0 {
        return Ok(Image::default());
    }
    let failed = "image: cannot be resized";
    let (source_width, source_height) = (image.width as u32, image.height as u32);
    let source = ImageRef::new(source_width, source_height, &image.pixels, PixelType::U8x3);
    let source = source.context(failed)?;
    let mut resized = Pixels::new(width as u32, height as u32, PixelType::U8x3);
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Lanczos3));
    Resizer::new().resize(&source, &mut resized, &options).context(failed)?;
    Ok(Image { height, width, pixels: resized.into_vec().into() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_of_another_size_is_resized_and_one_of_the_right_size_is_not_touched() {
        let pixels: Vec<u8> = (0..4 * 6 * 3).map(|index| index as u8).collect();
        let image = Image { height: 4, width: 6, pixels: pixels.into() };
        let same = fit_image(image.clone(), (4, 6)).expect("the same");
        assert_eq!(same.pixels, image.pixels);
        let other = fit_image(image, (3, 3)).expect("resized");
        assert_eq!((other.height, other.width, other.pixels.len()), (3, 3, 27));
        let grey = Image { height: 9, width: 5, pixels: vec![77; 9 * 5 * 3].into() };
        assert!(fit_image(grey, (4, 4)).expect("resized").pixels.iter().all(|pixel| *pixel == 77));
    }
}
