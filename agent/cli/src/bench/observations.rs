//! Reads the recorded observations that the policy is timed on.

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use safetensors::SafeTensors;
use safetensors::tensor::Dtype;

use decision::{Image, Observation};

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
                Ok(Observation { image, state: Vec::new(), instruction, expert_action: None })
            })
            .collect()
    };
    read().with_context(|| format!("observations in {}", file.display()))
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
}
