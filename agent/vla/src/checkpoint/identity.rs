//! A checkpoint's identity: a digest of what it computes, independent of how its files are written.
//!
//! Two folders have the same identity exactly if the following have equal values: the configuration
//! with defaults filled in and only the selected dataset's statistics, the tokenizer, and the
//! weights in use. Shards, key order, indentation, the dtype of the weights, comments and unused
//! fields do not matter.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;

use anyhow::{Context, Result, anyhow};
use sha2::{Digest, Sha256};

use super::config::Config;
use super::shards::{Shards, number_format};
use super::weights::is_dead;
use crate::network::vision::VisionBackbone;

/// Number of weights converted at a time.
const CHUNK: usize = 1 << 16;
/// Tensors that wait for the hashing thread.
const TENSORS_WAITING: usize = 1;

/// What the digest covers besides the weights, in the order in which it is hashed.
pub struct Fingerprint {
    config: Vec<u8>,
    tokenizer: Vec<u8>,
}

/// A digest in progress. The tensors are hashed by name, in a thread of its own, while the network
/// is made of them; a tensor that was needed earlier than its turn is read a second time.
pub struct Hashing {
    /// Names in the order of the digest.
    waiting: VecDeque<String>,
    tensors: SyncSender<Part>,
    thread: JoinHandle<Sha256>,
    /// Bytes that were read for the digest alone.
    bytes_read_again: usize,
}

/// A tensor to hash.
struct Part {
    name: String,
    shape: Vec<usize>,
    bytes: Vec<u8>,
    format: (usize, fn(&[u8]) -> f32),
}

impl Fingerprint {
    /// Of a configuration and the tokenizer in a folder.
    pub fn of(directory: &Path, config: &Config) -> Result<Fingerprint> {
        let path = directory.join("tokenizer.json");
        let read =
            || -> Result<serde_json::Value> { Ok(serde_json::from_slice(&std::fs::read(&path)?)?) };
        let tokenizer = read().with_context(|| format!("cannot read {}", path.display()))?;
        // Keys of a `Value` are sorted.
        Ok(Fingerprint {
            config: serde_json::to_vec(config)?,
            tokenizer: serde_json::to_vec(&tokenizer)?,
        })
    }

    /// The digest of these parts alone.
    pub fn digest(&self) -> String {
        hexadecimal(self.hasher())
    }

    fn hasher(&self) -> Sha256 {
        let mut hasher = Sha256::new();
        part(&mut hasher, &self.config);
        part(&mut hasher, &self.tokenizer);
        hasher
    }

    /// SHA-256 of what a checkpoint computes, in hexadecimal; reads all weights in use.
    pub fn identity(&self, shards: &Shards, config: &Config) -> Result<String> {
        Ok(self.start(shards, config)?.complete(shards)?.0)
    }

    /// Starts a digest of the weights that this configuration uses.
    pub fn start(&self, shards: &Shards, config: &Config) -> Result<Hashing> {
        let mut hasher = self.hasher();
        let (tensors, parts) = sync_channel::<Part>(TENSORS_WAITING);
        let thread = std::thread::Builder::new()
            .name("digest".to_owned())
            .spawn(move || {
                parts.iter().for_each(|tensor| tensor.hash(&mut hasher));
                hasher
            })
            .context("cannot start a thread for the digest")?;
        let waiting = used_tensors(shards, config).into();
        Ok(Hashing { waiting, tensors, thread, bytes_read_again: 0 })
    }
}

impl Hashing {
    /// Hashes a tensor that was just read, after all tensors whose turn is earlier.
    pub fn take(&mut self, shards: &Shards, name: &str, bytes: Vec<u8>) -> Result<()> {
        if self.waiting.front().is_some_and(|next| next.as_str() <= name) {
            self.advance(shards, Some(name))?;
        }
        if self.waiting.front().is_some_and(|next| next == name) {
            self.waiting.pop_front();
            self.send(shards, name, bytes)?;
        }
        Ok(())
    }

    /// Reads and hashes the tensors before `end`, or all.
    fn advance(&mut self, shards: &Shards, end: Option<&str>) -> Result<()> {
        while let Some(name) =
            self.waiting.pop_front_if(|next| end.is_none_or(|end| next.as_str() < end))
        {
            let stored = &shards.tensors()[&name];
            let bytes = shards.read(&name, stored)?;
            self.bytes_read_again += bytes.len();
            self.send(shards, &name, bytes)?;
        }
        Ok(())
    }

    fn send(&self, shards: &Shards, name: &str, bytes: Vec<u8>) -> Result<()> {
        let stored = &shards.tensors()[name];
        let format = number_format(name, stored.dtype)?;
        let part = Part { name: name.to_owned(), shape: stored.shape.clone(), bytes, format };
        self.tensors.send(part).map_err(|_| anyhow!("the thread of the digest has ended"))
    }

    /// The digest in hexadecimal, and the bytes that were read for it alone: tensors that were not
    /// taken are read now.
    pub fn complete(mut self, shards: &Shards) -> Result<(String, usize)> {
        self.advance(shards, None)?;
        drop(self.tensors);
        let hasher = self.thread.join();
        let hasher = hasher.map_err(|_| anyhow!("the thread of the digest panicked"))?;
        Ok((hexadecimal(hasher), self.bytes_read_again))
    }
}

impl Part {
    /// Hashes the numbers in 32 bits, as the network uses them.
    fn hash(&self, hasher: &mut Sha256) {
        part(hasher, self.name.as_bytes());
        part(hasher, format!("{:?}", self.shape).as_bytes());
        let (width, widen) = self.format;
        let mut numbers = Vec::with_capacity(CHUNK);
        for bytes in self.bytes.chunks(CHUNK * width) {
            numbers.clear();
            numbers.extend(bytes.chunks_exact(width).map(widen));
            hasher.update(bytemuck::cast_slice::<f32, u8>(&numbers));
        }
    }
}

/// Hashes a part with its length before it, so that different lists of parts have different
/// digests.
fn part(hasher: &mut Sha256, bytes: &[u8]) {
    hasher.update((bytes.len() as u64).to_le_bytes());
    hasher.update(bytes);
}

fn hexadecimal(hasher: Sha256) -> String {
    hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The names of all tensors that affect an output, sorted.
pub fn used_tensors(shards: &Shards, config: &Config) -> Vec<String> {
    let towers = VisionBackbone::blocks_used(&config.towers);
    let towers: Vec<(&str, usize)> =
        towers.iter().map(|(name, blocks)| (name.as_str(), *blocks)).collect();
    let names = shards.tensors().keys().filter(|name| !is_dead(name, &towers));
    let mut names: Vec<String> = names.cloned().collect();
    names.sort();
    names
}
