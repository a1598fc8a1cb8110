//! Reads the recorded observations that the policy is timed on.

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use safetensors::SafeTensors;
use safetensors::tensor::Dtype;

use decision::{Image, Observation};

/// Numbers of a Bridge task's state. The recorded observations have none; times do not depend on it.
const STATE_NUMBERS: usize = 8;

/// Reads tensors `0.image`, `1.image`, … (height, width, 3) in u8, with metadata `observations` and `0.instruction`, ….
pub fn read(file: &Path) -> Result<Vec<Observation>> {
    let read = || -> Result<Vec<Observation>> {
        let bytes = std::fs::read(file)?;
        let tensors = SafeTensors::deserialize(&bytes)?;
        let (_, header) = SafeTensors::read_metadata(&bytes)?;
        let metadata = header.metadata().clone().context("expected metadata, got none")?;
        let count = metadata.get("observations").context("expected metadata observations")?;
        let count: usize = count.parse().context("metadata observations: expected a number")?;
        ensure!(count > 0, "expected at least 1 observation, got 0");
        (0..count)
            .map(|index| {
                let name = format!("{index}.image");
                let tensor = tensors.tensor(&name)?;
                let &[height, width, 3] = tensor.shape() else {
                    bail!("{name}: expected shape (height, width, 3), got {:?}", tensor.shape())
                };
                ensure!(
                    tensor.dtype() == Dtype::U8,
                    "{name}: expected U8, got {:?}",
                    tensor.dtype()
                );
                let image = Image { height, width, pixels: tensor.data().to_vec().into() };
                let name = format!("{index}.instruction");
                let instruction = metadata.get(&name);
                let instruction =
                    instruction.with_context(|| format!("expected metadata {name}"))?.clone();
                Ok(Observation {
                    image,
                    state: vec![0.0; STATE_NUMBERS],
                    instruction,
                    expert_action: None,
                })
            })
            .collect()
    };
    read().with_context(|| format!("observations in {}", file.display()))
}

/// The observations with images of this height and width, bilinearly scaled where they have another size.
pub fn scaled(observations: Vec<Observation>, (height, width): (usize, usize)) -> Vec<Observation> {
    let scale = |observation: Observation| {
        let image = &observation.image;
        if (image.height, image.width) == (height, width) {
            return observation;
        }
        let mut pixels = Vec::with_capacity(height * width * 3);
        for y in 0..height {
            for x in 0..width {
                let (row, column) = (place(y, height, image.height), place(x, width, image.width));
                pixels.extend((0..3).map(|colour| blended(image, row, column, colour)));
            }
        }
        let image = Image { height, width, pixels: pixels.into() };
        Observation { image, ..observation }
    };
    observations.into_iter().map(scale).collect()
}

/// The two rows or columns of the image that a row or column of the result lies between, and how far.
fn place(index: usize, size: usize, of: usize) -> (usize, usize, f32) {
    let centre = ((index as f32 + 0.5) * of as f32 / size as f32 - 0.5).clamp(0.0, (of - 1) as f32);
    let low = centre as usize;
    (low, (low + 1).min(of - 1), centre - low as f32)
}

fn blended(
    image: &Image,
    (top, bottom, down): (usize, usize, f32),
    (left, right, across): (usize, usize, f32),
    colour: usize,
) -> u8 {
    let value = |y: usize, x: usize| f32::from(image.pixels[(y * image.width + x) * 3 + colour]);
    let row = |y: usize| value(y, left) + (value(y, right) - value(y, left)) * across;
    (row(top) + (row(bottom) - row(top)) * down).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recorded_observations_are_read_whole_or_refused() {
        let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("../vla/tests/fixtures");
        let observations =
            read(&fixtures.join("bridge-small.safetensors")).expect("the recorded ones");
        assert_eq!(observations.len(), 8);
        let first = &observations[0];
        assert_eq!((first.image.height, first.image.pixels.len()), (128, 128 * 128 * 3));
        assert_eq!(first.instruction, "put carrot on plate");
        let error = read(&fixtures.join("tiny/model.safetensors")).expect_err("no observations");
        assert!(format!("{error:#}").contains("expected metadata"), "{error:#}");
    }

    #[test]
    fn observations_are_scaled_to_the_size_of_a_policy() {
        // Two columns: black and white.
        let pixels = [[0; 3], [255; 3], [0; 3], [255; 3]].concat();
        let image = Image { height: 2, width: 2, pixels: pixels.into() };
        let observation = Observation {
            image,
            state: vec![1.0],
            instruction: "lift".into(),
            expert_action: None,
        };
        let same = scaled(vec![observation.clone()], (2, 2)).remove(0);
        assert_eq!(same, observation);
        let wide = scaled(vec![observation], (1, 4)).remove(0);
        let red: Vec<u8> = wide.image.pixels.iter().step_by(3).copied().collect();
        assert_eq!(red, [0, 64, 191, 255]);
        assert_eq!((wide.image.height, wide.image.width, &*wide.instruction), (1, 4, "lift"));
    }
}
