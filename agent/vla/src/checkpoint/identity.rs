//! A checkpoint's identity: a digest of what it computes, independent of how its files are written.
//!
//! Two folders have the same identity exactly if the following have equal values: the configuration
//! with defaults filled in and only the selected dataset's statistics, the tokenizer, and the
//! weights in use. Shards, key order, indentation, the dtype of the weights, comments and unused
//! fields do not matter.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use half::{bf16, f16};
use safetensors::Dtype;
use safetensors::tensor::Metadata;
use sha2::{Digest, Sha256};

use super::config::Config;
use super::weights::{is_dead, weight_files};
use crate::network::vision::VisionBackbone;

/// Number of weights converted at a time: the file may be larger than the memory.
const CHUNK: usize = 1 << 16;
/// Maximum header size of the safetensors format, in bytes.
const HEADER_BYTES_MAX: u64 = 100_000_000;

/// A tensor in a file.
struct Stored {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    file: PathBuf,
    /// Offset in the file.
    begin: u64,
    bytes: usize,
}

/// SHA-256 of what the checkpoint in a folder computes, in hexadecimal.
pub fn identity(directory: &Path, config: &Config) -> Result<String> {
    let mut hasher = Sha256::new();
    part(&mut hasher, &serde_json::to_vec(config)?);
    let path = directory.join("tokenizer.json");
    let read =
        || -> Result<serde_json::Value> { Ok(serde_json::from_slice(&std::fs::read(&path)?)?) };
    let tokenizer = read().with_context(|| format!("cannot read {}", path.display()))?;
    // Keys of a `Value` are sorted.
    part(&mut hasher, &serde_json::to_vec(&tokenizer)?);
    for tensor in used_tensors(directory, config)? {
        part(&mut hasher, tensor.name.as_bytes());
        part(&mut hasher, format!("{:?}", tensor.shape).as_bytes());
        tensor
            .hash_values(&mut hasher)
            .with_context(|| format!("cannot read {} of {}", tensor.name, tensor.file.display()))?;
    }
    Ok(hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Hashes a part with its length before it, so that different lists of parts have different
/// digests.
fn part(hasher: &mut Sha256, bytes: &[u8]) {
    hasher.update((bytes.len() as u64).to_le_bytes());
    hasher.update(bytes);
}

/// All tensors that affect an output, sorted by name.
fn used_tensors(directory: &Path, config: &Config) -> Result<Vec<Stored>> {
    let towers = VisionBackbone::blocks_used(&config.towers);
    let towers: Vec<(&str, usize)> =
        towers.iter().map(|(name, blocks)| (name.as_str(), *blocks)).collect();
    let mut tensors = Vec::new();
    for file in weight_files(directory)? {
        let stored = stored_in(&file).with_context(|| format!("cannot read {}", file.display()))?;
        tensors.extend(stored.into_iter().filter(|tensor| !is_dead(&tensor.name, &towers)));
    }
    tensors.sort_by(|one, other| one.name.cmp(&other.name));
    Ok(tensors)
}

/// The tensors in a safetensors file's header.
fn stored_in(path: &Path) -> Result<Vec<Stored>> {
    let mut file = File::open(path)?;
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
    let stored = |(name, info): (String, &safetensors::tensor::TensorInfo)| Stored {
        name,
        dtype: info.dtype,
        shape: info.shape.clone(),
        file: path.to_path_buf(),
        begin: 8 + length + info.data_offsets.0 as u64,
        bytes: info.data_offsets.1 - info.data_offsets.0,
    };
    Ok(metadata.tensors().into_iter().map(stored).collect())
}

impl Stored {
    /// Hashes the numbers in 32 bits, as the network uses them.
    fn hash_values(&self, hasher: &mut Sha256) -> Result<()> {
        let (width, widen): (usize, fn(&[u8]) -> f32) = match self.dtype {
            Dtype::F32 => (4, bytemuck::pod_read_unaligned),
            Dtype::BF16 => (2, |bytes| bytemuck::pod_read_unaligned::<bf16>(bytes).to_f32()),
            Dtype::F16 => (2, |bytes| bytemuck::pod_read_unaligned::<f16>(bytes).to_f32()),
            other => bail!("expected 16- or 32-bit floating point numbers, got {other:?}"),
        };
        let mut file = File::open(&self.file)?;
        file.seek(SeekFrom::Start(self.begin))?;
        let mut reader = BufReader::new(file).take(self.bytes as u64);
        let (mut bytes, mut numbers) = (Vec::new(), Vec::with_capacity(CHUNK));
        let mut left = self.bytes;
        while left > 0 {
            let count = left.min(CHUNK * width);
            bytes.resize(count, 0);
            reader.read_exact(&mut bytes)?;
            numbers.clear();
            numbers.extend(bytes.chunks_exact(width).map(widen));
            hasher.update(bytemuck::cast_slice::<f32, u8>(&numbers));
            left -= count;
        }
        Ok(())
    }
}
