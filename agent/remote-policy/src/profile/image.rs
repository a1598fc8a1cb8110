//! The images of an observation.

use anyhow::{Context, Result, ensure};
use decision::Image;
use image::RgbImage;
use image::imageops::{self, FilterType};

use super::{Channels, ImageInput, Resize, Source};
use crate::codec::{Array, Dtype};

impl ImageInput {
    /// The image in the server's size.
    pub fn fit(&self, seen: &Image) -> Result<Image> {
        let (height, width) = (self.height, self.width);
        if self.source == Source::Black {
            return Ok(Image { height, width, pixels: vec![0; height * width * 3].into() });
        }
        if (seen.height, seen.width) == (height, width) {
            return Ok(seen.clone());
        }
        ensure!(
            self.resize != Resize::Refuse,
            "image: expected {height} x {width} pixels, got {} x {}",
            seen.height,
            seen.width
        );
        let source =
            RgbImage::from_raw(seen.width as u32, seen.height as u32, seen.pixels.to_vec());
        let source = source.context("image: expected height x width x 3 bytes")?;
        let resized = match self.resize {
            Resize::Pad => pad(&source, width as u32, height as u32),
            _ => imageops::resize(&source, width as u32, height as u32, FilterType::Triangle),
        };
        Ok(Image { height, width, pixels: resized.into_raw().into() })
    }

    /// The pixels in the server's order of dimensions.
    pub fn array(&self, image: &Image) -> Result<Array<'static>> {
        let (height, width) = (image.height, image.width);
        let pixels = &image.pixels;
        let (shape, bytes) = match self.channels {
            Channels::Last => (vec![height, width, 3], pixels.to_vec()),
            Channels::First => {
                let channel = |index| pixels.iter().skip(index).step_by(3).copied();
                (vec![3, height, width], (0..3).flat_map(channel).collect())
            }
        };
        Array::new(Dtype::U8, shape, bytes)
    }
}

/// Fits the image into the middle, as openpi's `resize_with_pad` does.
fn pad(source: &RgbImage, width: u32, height: u32) -> RgbImage {
    let ratio = (f64::from(source.width()) / f64::from(width))
        .max(f64::from(source.height()) / f64::from(height));
    let side = |length: u32, limit: u32| ((f64::from(length) / ratio) as u32).clamp(1, limit);
    let (inner_width, inner_height) = (side(source.width(), width), side(source.height(), height));
    let inner = imageops::resize(source, inner_width, inner_height, FilterType::Triangle);
    let mut padded = RgbImage::new(width, height);
    let (left, top) = ((width - inner_width) / 2, (height - inner_height) / 2);
    imageops::replace(&mut padded, &inner, left.into(), top.into());
    padded
}
