//! Seeds that are derived from an episode's identity, never from a worker, an order or the time.

use sha2::{Digest, Sha256};

use crate::TaskId;

/// Every reader of a record, including JavaScript, must represent a seed exactly.
const SAMPLING_SEEDS: u64 = 1 << 53;

/// The name of an episode in the derivation of its seeds: `TASK/VARIANT/NUMBER`.
pub fn episode_name(TaskId { task, variant }: &TaskId, number: u32) -> String {
    format!("{task}/{variant}/{number}")
}

/// Seed of the policy's sampling in a whole episode; `seed` is that of the command line.
pub fn sampling_seed(episode: &str, seed: u64) -> u64 {
    episode_hash("sample", episode, seed) % SAMPLING_SEEDS
}

/// A hash that is the same on every machine and in every version of this program: the first eight
/// bytes, little endian, of the SHA-256 of `PURPOSE/EPISODE/SEED`.
pub fn episode_hash(purpose: &str, episode: &str, seed: u64) -> u64 {
    let digest = Sha256::digest(format!("{purpose}/{episode}/{seed}"));
    let mut bytes = [0; 8];
    bytes.copy_from_slice(&digest[..8]);
    u64::from_le_bytes(bytes)
}
