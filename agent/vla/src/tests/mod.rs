//! Tests of the whole policy: parity with PyTorch, shared prefixes, batches, seeds, refusals.

mod backbone;
mod checkpoint;
mod families;
mod loading;
mod options;
mod parity;
mod proposal;

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use candle_core::{DType, Device, Tensor};

use decision::{Image, Policy as _};

use super::{Backend, DeviceName, LoadOptions, Loading, Vla, WeightFormat};
use crate::checkpoint::weights::Target;

/// Both tiny layouts: one tower as in the shipped model, two as in OpenVLA-7B.
const TINY: [&str; 2] = ["tiny", "tiny-fused"];

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures")
}

fn tiny(name: &str, backend: Backend) -> Result<Vla> {
    Vla::load_on(&fixtures().join(name), &Device::Cpu, backend, &LoadOptions::default())
}

/// The golden tensors of one file by name.
struct Golden(std::collections::HashMap<String, Tensor>);

impl Golden {
    fn load(file: &Path) -> Result<Golden> {
        Ok(Golden(candle_core::safetensors::load(file, &Device::Cpu)?))
    }

    fn tensor(&self, name: &str) -> Result<&Tensor> {
        self.0.get(name).with_context(|| format!("golden tensors: expected {name}"))
    }

    fn ids(&self, name: &str) -> Result<Vec<u32>> {
        Ok(self.tensor(name)?.to_dtype(DType::U32)?.to_vec1()?)
    }

    fn image(&self, name: &str) -> Result<Image> {
        let tensor = self.tensor(name)?;
        let (height, width, _) = tensor.dims3()?;
        Ok(Image { height, width, pixels: tensor.flatten_all()?.to_vec1()?.into() })
    }
}

fn largest_difference(a: &Tensor, b: &Tensor) -> Result<f32> {
    Ok((a - b)?.abs()?.max_all()?.to_scalar()?)
}
