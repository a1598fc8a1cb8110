//! The tensors in a checkpoint's weight files: where each lies, and its bytes when they are needed.
//!
//! Tensors are read one at a time. A checkpoint of 15 GB therefore needs the memory of the network
//! made of it, plus a few times that of its largest tensor.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use half::{bf16, f16};
use rayon::prelude::*;
use safetensors::Dtype;
use safetensors::tensor::{Metadata, TensorInfo};
use serde::Deserialize;

/// Maximum header size of the safetensors format, in bytes.
const HEADER_BYTES_MAX: u64 = 100_000_000;
/// Numbers converted by one task.
const TASK_NUMBERS: usize = 1 << 20;

/// All tensors of a checkpoint, by name; their values stay in the files.
pub struct Shards {
    files: Vec<(PathBuf, File)>,
    tensors: HashMap<String, StoredTensor>,
}

/// Where a tensor lies.
#[derive(Clone, Debug)]
pub struct StoredTensor {
    pub shape: Vec<usize>,
    pub dtype: Dtype,
    /// Index of the file.
    file: usize,
    /// Offset in the file.
    begin: u64,
    pub bytes: usize,
}

/// The index of a sharded checkpoint: which shard holds which tensor.
#[derive(Deserialize)]
struct Index {
    weight_map: HashMap<String, String>,
}

impl Shards {
    /// Opens the weight files of a folder and reads their headers.
    pub fn open(directory: &Path) -> Result<Shards> {
        let (mut files, mut tensors) = (Vec::new(), HashMap::new());
        for path in weight_files(directory)? {
            let name = || format!("cannot read {}", path.display());
            let file = File::open(&path).with_context(name)?;
            for (tensor, stored) in stored_in(&file, files.len()).with_context(name)? {
                ensure!(
                    !tensors.contains_key(&tensor),
                    "weights: expected {tensor} once, got it again in {}",
                    path.display()
                );
                tensors.insert(tensor, stored);
            }
            files.push((path, file));
        }
        Ok(Shards { files, tensors })
    }

    /// Names of all tensors, with where they lie.
    pub fn tensors(&self) -> &HashMap<String, StoredTensor> {
        &self.tensors
    }

    /// The bytes of a tensor.
    pub fn read(&self, name: &str, tensor: &StoredTensor) -> Result<Vec<u8>> {
        let (path, file) = &self.files[tensor.file];
        let mut bytes = vec![0; tensor.bytes];
        file.read_exact_at(&mut bytes, tensor.begin)
            .with_context(|| format!("cannot read {name} of {}", path.display()))?;
        Ok(bytes)
    }
}

/// The weight files of a checkpoint: a single file, or the shards in the index.
pub fn weight_files(directory: &Path) -> Result<Vec<PathBuf>> {
    let single = directory.join(SINGLE_FILE);
    if single.exists() {
        return Ok(vec![single]);
    }
    let index = read_index(directory)?;
    let mut names: Vec<&String> = index.weight_map.values().collect();
    names.sort();
    names.dedup();
    Ok(names.into_iter().map(|name| directory.join(name)).collect())
}

/// The sorted names of all tensors, from the header of the only file or the index of the shards.
pub fn tensor_names(directory: &Path) -> Result<Vec<String>> {
    let single = directory.join(SINGLE_FILE);
    let mut names: Vec<String> = if single.exists() {
        stored_in(&File::open(&single)?, 0)?.into_iter().map(|(name, _)| name).collect()
    } else {
        read_index(directory)?.weight_map.into_keys().collect()
    };
    names.sort();
    Ok(names)
}

fn read_index(directory: &Path) -> Result<Index> {
    let (single, path) = (directory.join(SINGLE_FILE), directory.join(INDEX_FILE));
    let text = std::fs::read_to_string(&path).with_context(|| {
        format!("weights: expected {} or {}, got neither", single.display(), path.display())
    })?;
    serde_json::from_str(&text).with_context(|| format!("cannot parse {}", path.display()))
}

/// The only file of a checkpoint without shards.
const SINGLE_FILE: &str = "model.safetensors";
/// The index of a sharded checkpoint.
pub const INDEX_FILE: &str = "model.safetensors.index.json";

/// The tensors in a safetensors file's header.
fn stored_in(mut file: &File, index: usize) -> Result<Vec<(String, StoredTensor)>> {
    let mut length = [0; 8];
    file.read_exact(&mut length)?;
    let length = u64::from_le_bytes(length);
    ensure!(
        length <= HEADER_BYTES_MAX,
        "safetensors header: expected at most {HEADER_BYTES_MAX} bytes, got {length}"
    );
    let mut header = vec![0; usize::try_from(length)?];
    file.read_exact(&mut header)?;
    let metadata: Metadata = serde_json::from_slice(&header).context("safetensors header")?;
    let expected = 8 + length + metadata.data_len() as u64;
    let found = file.metadata()?.len();
    ensure!(found == expected, "safetensors file: expected {expected} bytes, got {found}");
    let stored = |(name, info): (String, &TensorInfo)| {
        let stored = StoredTensor {
            shape: info.shape.clone(),
            dtype: info.dtype,
            file: index,
            begin: 8 + length + info.data_offsets.0 as u64,
            bytes: info.data_offsets.1 - info.data_offsets.0,
        };
        (name, stored)
    };
    Ok(metadata.tensors().into_iter().map(stored).collect())
}

/// Reads one number of a file.
pub type Widen = fn(&[u8]) -> f32;

/// Bytes per number and the conversion of one number; an error for other than floating point
/// numbers of 16 or 32 bits.
pub fn number_format(name: &str, dtype: Dtype) -> Result<(usize, Widen)> {
    Ok(match dtype {
        Dtype::F32 => (4, bytemuck::pod_read_unaligned),
        Dtype::BF16 => (2, |bytes| bytemuck::pod_read_unaligned::<bf16>(bytes).to_f32()),
        Dtype::F16 => (2, |bytes| bytemuck::pod_read_unaligned::<f16>(bytes).to_f32()),
        other => {
            bail!("{name}: expected 16- or 32-bit floating point numbers, got {other:?}")
        }
    })
}

/// The numbers of a tensor in 32 bits.
pub fn widen(bytes: &[u8], (width, widen): (usize, fn(&[u8]) -> f32)) -> Vec<f32> {
    let mut numbers = vec![0.0f32; bytes.len() / width];
    numbers.par_chunks_mut(TASK_NUMBERS).zip(bytes.par_chunks(TASK_NUMBERS * width)).for_each(
        |(numbers, bytes)| {
            for (number, bytes) in numbers.iter_mut().zip(bytes.chunks_exact(width)) {
                *number = widen(bytes);
            }
        },
    );
    numbers
}
