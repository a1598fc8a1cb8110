//! A checkpoint's tensors by name, read when a layer takes them. Missing, misshapen or unused tensors
//! are errors.

use std::collections::{BTreeMap, HashMap};

use anyhow::{Result, bail, ensure};
use candle_core::{Device, Tensor};

use super::identity::Hashing;
use super::shards::{Shards, StoredTensor, number_format, widen};
use crate::kernels::backend::Backend;
use crate::kernels::matmul::WeightFormat;

/// Name prefixes within a vision tower of tensors that affect no output, in addition to unused
/// blocks.
const DEAD_TOWER_PARTS: [&str; 2] = ["norm.", "attn_pool."];

/// How far a checkpoint is loaded, in bytes of the tensors in use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Loaded {
    /// Read so far.
    pub bytes: u64,
    /// To read in total.
    pub bytes_total: u64,
}

/// The tensors that no layer has taken yet.
pub struct Weights<'a> {
    shards: &'a Shards,
    /// Names of the tensors that affect an output, sorted.
    used: &'a [String],
    left: HashMap<&'a str, &'a StoredTensor>,
    hashing: Option<Hashing>,
    loaded: Loaded,
    report: &'a dyn Fn(Loaded),
    target: Target,
}

/// What was left of a checkpoint when every layer had taken its tensors.
#[derive(Debug, PartialEq, Eq)]
pub struct Rest {
    /// Number of tensors that affect no output.
    pub dead_weights: usize,
    /// The digest, if one was in progress.
    pub digest: Option<String>,
    /// Bytes that were read a second time, for the digest alone.
    pub bytes_read_again: usize,
}

/// What layers are made with.
#[derive(Clone, Debug)]
pub struct Target {
    pub device: Device,
    pub backend: Backend,
    /// Of the decoder's matrices.
    pub format: WeightFormat,
}

impl Target {
    /// The same with the checkpoint's values: vision and projector are not read in every step.
    pub fn exact(self) -> Target {
        Target { format: WeightFormat::Exact, ..self }
    }
}

/// All tensors whose names start with the same prefix.
pub struct Part<'a, 'b> {
    weights: &'a mut Weights<'b>,
    name: String,
}

impl<'a> Weights<'a> {
    /// Of all tensors of a checkpoint; `used` are the names of those that affect an output. They
    /// are hashed as they are read. `report` is called after each tensor.
    pub fn new(
        shards: &'a Shards,
        used: &'a [String],
        hashing: Option<Hashing>,
        target: Target,
        report: &'a dyn Fn(Loaded),
    ) -> Weights<'a> {
        let left = shards.tensors().iter().map(|(name, stored)| (name.as_str(), stored));
        let bytes_total = used.iter().map(|name| shards.tensors()[name].bytes as u64).sum();
        Weights {
            shards,
            used,
            left: left.collect(),
            hashing,
            loaded: Loaded { bytes: 0, bytes_total },
            report,
            target,
        }
    }

    /// The tensors whose names start with `name`.
    pub fn part(&mut self, name: &str) -> Part<'_, 'a> {
        Part { weights: self, name: name.to_string() }
    }

    /// Completes the digest. A remaining tensor that is not known to be unused is an error.
    pub fn finish(self) -> Result<Rest> {
        let used = self.used;
        let is_used =
            |name: &&str| used.binary_search_by(|known| known.as_str().cmp(*name)).is_ok();
        let (unexpected, dead): (Vec<&str>, Vec<&str>) =
            self.left.keys().partition(|name| is_used(name));
        if let Some(name) = unexpected.iter().min() {
            bail!(
                "weights: expected only known tensors, got {} others, such as {name}",
                unexpected.len()
            );
        }
        let hashed = self.hashing.map(|hashing| hashing.complete(self.shards)).transpose()?;
        let (digest, bytes_read_again) = hashed.unzip();
        let bytes_read_again = bytes_read_again.unwrap_or(0);
        Ok(Rest { dead_weights: dead.len(), digest, bytes_read_again })
    }
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

impl<'b> Part<'_, 'b> {
    /// The tensors of this part whose names continue with `name`.
    pub fn part(&mut self, name: &str) -> Part<'_, 'b> {
        Part { name: self.full_name(name), weights: self.weights }
    }

    /// Removes a tensor and returns it as f32 on the device; its shape must be `shape`.
    pub fn take(&mut self, name: &str, shape: &[usize]) -> Result<Tensor> {
        Ok(self.take_to_host(name, shape)?.to_device(&self.weights.target.device)?)
    }

    /// Like [`Part::take`], in the memory of the CPU.
    pub fn take_to_host(&mut self, name: &str, shape: &[usize]) -> Result<Tensor> {
        let name = self.full_name(name);
        let weights = &mut *self.weights;
        let Some((key, stored)) = weights.left.remove_entry(name.as_str()) else {
            bail!("weights: expected {name} of shape {shape:?}, got none");
        };
        ensure!(stored.shape == shape, "{name}: expected {shape:?}, got {:?}", stored.shape);
        let format = number_format(key, stored.dtype)?;
        let bytes = weights.shards.read(key, stored)?;
        let numbers = widen(&bytes, format);
        if let Some(hashing) = &mut weights.hashing {
            hashing.take(weights.shards, key, bytes)?;
        }
        weights.loaded.bytes += stored.bytes as u64;
        (weights.report)(weights.loaded);
        Ok(Tensor::from_vec(numbers, shape, &Device::Cpu)?)
    }

    /// What layers are made with.
    pub fn target(&self) -> Target {
        self.weights.target.clone()
    }

    fn full_name(&self, name: &str) -> String {
        if self.name.is_empty() { name.to_string() } else { format!("{}.{name}", self.name) }
    }
}

/// Loads parts 0 to `count` - 1 in the order of their names, in which 10 comes before 2; returns them
/// in the order of their numbers.
pub fn in_order<T>(count: usize, mut load: impl FnMut(usize) -> Result<T>) -> Result<Vec<T>> {
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by_key(usize::to_string);
    let parts = order.into_iter().map(|index| Ok((index, load(index)?)));
    Ok(parts.collect::<Result<BTreeMap<usize, T>>>()?.into_values().collect())
}
