//! A checkpoint's tensors by name. Missing, misshapen or unused tensors are errors.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use candle_core::{DType, Device, Tensor};
use serde::Deserialize;

use crate::kernels::backend::Backend;

/// Name prefixes within a vision tower of tensors that affect no output, in addition to unused
/// blocks.
const DEAD_TOWER_PARTS: [&str; 2] = ["norm.", "attn_pool."];

/// The tensors that no layer has taken yet.
pub struct Weights {
    tensors: HashMap<String, Tensor>,
    device: Device,
    /// The backend of the layers made of these weights.
    pub backend: Backend,
}

/// All tensors whose names start with the same prefix.
pub struct Part<'a> {
    weights: &'a mut Weights,
    name: String,
}

/// The index of a sharded checkpoint: which shard holds which tensor.
#[derive(Deserialize)]
struct Index {
    weight_map: HashMap<String, String>,
}

impl Weights {
    /// Loads all tensors of a checkpoint's files.
    pub fn load(files: &[PathBuf], device: &Device, backend: Backend) -> Result<Weights> {
        let mut tensors = HashMap::new();
        for file in files {
            let name = || format!("cannot read {}", file.display());
            tensors.extend(candle_core::safetensors::load(file, device).with_context(name)?);
        }
        Ok(Weights { tensors, device: device.clone(), backend })
    }

    /// The tensors whose names start with `name`.
    pub fn part(&mut self, name: &str) -> Part<'_> {
        Part { weights: self, name: name.to_string() }
    }

    /// Returns the number of remaining tensors that are known to be unused; any other remaining
    /// tensor is an error.
    pub fn finish(self, towers: &[(&str, usize)]) -> Result<usize> {
        let (dead, unexpected): (Vec<&String>, Vec<&String>) =
            self.tensors.keys().partition(|name| is_dead(name, towers));
        if let Some(name) = unexpected.iter().min() {
            bail!(
                "weights: expected only known tensors, got {} others, such as {name}",
                unexpected.len()
            );
        }
        Ok(dead.len())
    }
}

/// The weight files of a checkpoint: a single file, or the shards in the index.
pub fn weight_files(directory: &Path) -> Result<Vec<PathBuf>> {
    let single = directory.join("model.safetensors");
    if single.exists() {
        return Ok(vec![single]);
    }
    let path = directory.join("model.safetensors.index.json");
    let text = std::fs::read_to_string(&path).with_context(|| {
        format!("weights: expected {} or {}, got neither", single.display(), path.display())
    })?;
    let index: Index =
        serde_json::from_str(&text).with_context(|| format!("cannot parse {}", path.display()))?;
    let mut names: Vec<&String> = index.weight_map.values().collect();
    names.sort();
    names.dedup();
    Ok(names.into_iter().map(|name| directory.join(name)).collect())
}

/// Positions that older versions of transformers save with every layer; they are computed here.
const DEAD_SUFFIX: &str = ".rotary_emb.inv_freq";

/// Whether a tensor affects no output; `towers` are the vision towers' names with their numbers of
/// used blocks.
pub fn is_dead(name: &str, towers: &[(&str, usize)]) -> bool {
    if name.ends_with(DEAD_SUFFIX) {
        return true;
    }
    towers.iter().any(|(tower, blocks_used)| {
        let Some(rest) = name.strip_prefix(tower).and_then(|rest| rest.strip_prefix('.')) else {
            return false;
        };
        let block = rest.strip_prefix("blocks.").and_then(|rest| rest.split('.').next());
        match block.and_then(|index| index.parse::<usize>().ok()) {
            Some(index) => index >= *blocks_used,
            None => DEAD_TOWER_PARTS.iter().any(|part| rest.starts_with(part)),
        }
    })
}

impl Part<'_> {
    /// The tensors of this part whose names continue with `name`.
    pub fn part(&mut self, name: &str) -> Part<'_> {
        Part { name: self.full_name(name), weights: self.weights }
    }

    /// Removes a tensor and returns it as f32; its shape must be `shape`.
    pub fn take(&mut self, name: &str, shape: &[usize]) -> Result<Tensor> {
        let name = self.full_name(name);
        let Some(tensor) = self.weights.tensors.remove(&name) else {
            bail!("weights: expected {name} of shape {shape:?}, got none");
        };
        ensure!(tensor.dims() == shape, "{name}: expected {shape:?}, got {:?}", tensor.dims());
        let kind = tensor.dtype();
        ensure!(
            [DType::F32, DType::F16, DType::BF16].contains(&kind),
            "{name}: expected 16- or 32-bit floating point numbers, got {kind:?}"
        );
        Ok(tensor.to_dtype(DType::F32)?)
    }

    /// The backend of the layers made of these weights.
    pub fn backend(&self) -> Backend {
        self.weights.backend
    }

    /// The device of the tensors.
    pub fn device(&self) -> Device {
        self.weights.device.clone()
    }

    fn full_name(&self, name: &str) -> String {
        if self.name.is_empty() { name.to_string() } else { format!("{}.{name}", self.name) }
    }
}
