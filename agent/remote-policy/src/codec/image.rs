//! Camera images: NumPy arrays of pixels, and vla-eval's PNG, JPEG and raw images.

use std::io::Cursor;

use anyhow::{Context, Result, bail, ensure};
use decision::Image;
use image::{ImageFormat, ImageReader, Limits};

use super::{Array, Dtype, KeyForm, Value};

/// Maximum height and width of an image, checked before its pixels are decoded.
pub const IMAGE_SIDE_MAX: usize = 2048;

/// How an image is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageForm {
    /// A NumPy array of height x width x 3.
    Array(KeyForm),
    /// vla-eval's uncompressed image.
    Raw,
}

/// Encodes an image without compression.
pub fn image_value(image: &Image, form: ImageForm) -> Result<Value<'_>> {
    let shape = vec![image.height, image.width, 3];
    let array = Array::new(Dtype::U8, shape, &*image.pixels).context("image")?;
    if let ImageForm::Array(keys) = form {
        return Ok(array.into_value(keys));
    }
    let shape = array.shape.iter().map(|length| Value::Integer(*length as i128)).collect();
    Ok(Value::map([
        ("__image__", Value::Bool(true)),
        ("format", Value::text("raw")),
        ("data", Value::Bytes(array.bytes)),
        ("dtype", Value::Text(array.dtype.text().into())),
        ("shape", Value::List(shape)),
    ]))
}

/// Decodes an image in any of the forms: height x width x 3 pixels of 8 bits.
pub fn decode_image(value: &Value<'_>) -> Result<Image> {
    decode(value).context("image")
}

fn decode(value: &Value<'_>) -> Result<Image> {
    if value.get("__image__").is_none() {
        return from_array(&Array::from_value(value)?);
    }
    let known = ["__image__", "format", "data", "dtype", "shape"];
    if let Some((key, _)) = value.entries()?.iter().find(|(key, _)| !known.contains(&&*key.name)) {
        bail!("expected the keys {}, got {:?}", known.join(", "), super::printable(&key.name));
    }
    let Value::Bytes(data) = value.field("data")? else {
        bail!("expected bytes as data, got {}", value.field("data")?.kind());
    };
    let Value::List(shape) = value.field("shape")? else {
        bail!("expected a list as shape, got {}", value.field("shape")?.kind());
    };
    let shape: Vec<usize> = shape.iter().map(Value::as_integer).collect::<Result<_>>()?;
    match value.field("format")?.as_text()? {
        "raw" => {
            let dtype = Dtype::parse(value.field("dtype")?.as_text()?)?;
            from_array(&Array::new(dtype, shape, &**data)?)
        }
        "png" => compressed(data, ImageFormat::Png, &shape),
        "jpeg" => compressed(data, ImageFormat::Jpeg, &shape),
        other => bail!("expected the format png, jpeg or raw, got {:?}", super::printable(other)),
    }
}

fn from_array(array: &Array<'_>) -> Result<Image> {
    let dtype = array.dtype;
    ensure!(dtype == Dtype::U8, "expected pixels of type \"|u1\", got {:?}", dtype.text());
    let (height, width) = sides(&array.shape)?;
    Ok(Image { height, width, pixels: array.bytes.to_vec().into() })
}

/// The announced shape is checked first, so that a small file cannot become a huge image.
fn compressed(data: &[u8], format: ImageFormat, shape: &[usize]) -> Result<Image> {
    let (height, width) = sides(shape)?;
    let mut reader = ImageReader::with_format(Cursor::new(data), format);
    let mut limits = Limits::default();
    limits.max_image_height = Some(height as u32);
    limits.max_image_width = Some(width as u32);
    limits.max_alloc = Some(4 * IMAGE_SIDE_MAX as u64 * IMAGE_SIDE_MAX as u64 * 3);
    reader.limits(limits);
    let image = reader.decode().context("cannot decode the pixels")?.into_rgb8();
    let got = (image.height() as usize, image.width() as usize);
    ensure!(
        got == (height, width),
        "expected {height} x {width} pixels, got {} x {}",
        got.0,
        got.1
    );
    Ok(Image { height, width, pixels: image.into_raw().into() })
}

/// Height and width of an RGB image.
fn sides(shape: &[usize]) -> Result<(usize, usize)> {
    let &[height, width, 3] = shape else {
        bail!("expected the shape [height, width, 3], got {shape:?}");
    };
    for side in [height, width] {
        ensure!(
            (1..=IMAGE_SIDE_MAX).contains(&side),
            "expected sides of 1 to {IMAGE_SIDE_MAX} pixels, got {height} x {width}"
        );
    }
    Ok((height, width))
}
