//! Keeps the digest of a large checkpoint beside its files, so that the next load does not read all
//! weights twice.
//!
//! An entry counts only if every file has the size and the times that it had when the digest was
//! computed, and if configuration and tokenizer are the same.

use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::identity::Fingerprint;
use super::shards::{INDEX_FILE, weight_files};

/// The file in the checkpoint's folder.
pub const CACHE_FILE: &str = ".rever-digest.json";
/// Version of the file's format.
const VERSION: u32 = 1;
/// The digest of fewer bytes is computed in less than a second and not kept.
const BYTES_MIN: u64 = 1 << 30;
/// Number of configurations whose digests are kept.
const ENTRIES_MAX: usize = 16;
/// A file that changed so recently may change again without a new time.
const SETTLED_SECS: u64 = 3;
/// Maximum size of the file.
const FILE_BYTES_MAX: u64 = 1 << 20;

/// Where the digests of one checkpoint are kept, and the state of its files.
#[derive(Clone)]
pub struct DigestCache {
    /// In the checkpoint's folder; then elsewhere, for folders that cannot be written.
    places: Vec<PathBuf>,
    files: Vec<Stamp>,
    is_large: bool,
    settled_secs: u64,
}

/// What changes when a file changes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Stamp {
    name: String,
    bytes: u64,
    modified_ns: i128,
    /// Of contents or attributes; cannot be set by a program.
    changed_ns: i128,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    version: u32,
    files: Vec<Stamp>,
    /// Digest of configuration and tokenizer -> digest of the checkpoint.
    digests: BTreeMap<String, String>,
}

impl DigestCache {
    /// Of the checkpoint in a folder; `elsewhere` is a folder for the digests of folders that
    /// cannot be written.
    pub fn open(directory: &Path, elsewhere: Option<&Path>) -> Result<DigestCache> {
        let weights = weight_files(directory)?;
        let others = ["config.json", "tokenizer.json", "dataset_statistics.json", INDEX_FILE];
        let others = others.map(|name| directory.join(name)).into_iter();
        let others = others.filter(|path| path.exists());
        let files = weights.iter().cloned().chain(others).map(|path| Stamp::of(&path));
        let files: Vec<Stamp> = files.collect::<Result<_>>()?;
        let bytes: u64 = files.iter().take(weights.len()).map(|file| file.bytes).sum();
        let mut places = vec![directory.join(CACHE_FILE)];
        if let Some(elsewhere) = elsewhere {
            let path = directory.canonicalize().unwrap_or_else(|_| directory.to_owned());
            let name = hexadecimal(&Sha256::digest(path.as_os_str().as_encoded_bytes()));
            places.push(elsewhere.join(format!("{}.json", &name[..16])));
        }
        Ok(DigestCache { places, files, is_large: bytes >= BYTES_MIN, settled_secs: SETTLED_SECS })
    }

    /// For tests: keeps digests of small checkpoints, too.
    #[cfg(test)]
    pub fn of_any_size(self) -> DigestCache {
        DigestCache { is_large: true, ..self }
    }

    /// For tests: trusts files that have just been written.
    #[cfg(test)]
    pub fn settled_at_once(self) -> DigestCache {
        DigestCache { settled_secs: 0, ..self }
    }

    /// The kept digest, if nothing has changed since it was computed.
    pub fn digest(&self, fingerprint: &Fingerprint) -> Option<String> {
        let key = fingerprint.digest();
        self.places.iter().find_map(|place| self.read(place)?.digests.remove(&key))
    }

    /// Keeps a digest in the first place that can be written. A digest that cannot be kept is
    /// computed again next time.
    pub fn keep(&self, fingerprint: &Fingerprint, digest: &str) {
        if !self.is_large || !self.is_settled() {
            return;
        }
        for place in &self.places {
            match self.write(place, fingerprint, digest) {
                Ok(()) => return,
                Err(error) => tracing::debug!("the digest is not kept: {error:#}"),
            }
        }
    }

    fn read(&self, place: &Path) -> Option<Kept> {
        if std::fs::metadata(place).ok()?.len() > FILE_BYTES_MAX {
            return None;
        }
        let kept: Kept = serde_json::from_slice(&std::fs::read(place).ok()?).ok()?;
        (kept.version == VERSION && kept.files == self.files).then_some(kept)
    }

    fn write(&self, place: &Path, fingerprint: &Fingerprint, digest: &str) -> Result<()> {
        let mut digests = self.read(place).map(|kept| kept.digests).unwrap_or_default();
        while digests.len() >= ENTRIES_MAX {
            digests.pop_first();
        }
        digests.insert(fingerprint.digest(), digest.to_owned());
        let kept = Kept { version: VERSION, files: self.files.clone(), digests };
        let text = serde_json::to_string_pretty(&kept)? + "\n";
        let name = || format!("cannot write {}", place.display());
        let folder = place.parent().context("a file has a folder")?;
        if self.places.first().is_none_or(|beside| place != beside) {
            std::fs::create_dir_all(folder).with_context(name)?;
        }
        // Of this process, so that two processes never write one file.
        let partial = place.with_extension(format!("{}.partial", std::process::id()));
        std::fs::write(&partial, text).with_context(name)?;
        std::fs::rename(&partial, place).with_context(name)
    }

    /// Whether the files are what they were when the digest was begun, and old enough for a later
    /// change to change their times.
    fn is_settled(&self) -> bool {
        let Some(folder) = self.places.first().and_then(|place| place.parent()) else {
            return false;
        };
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let settled = i128::try_from(now.as_nanos()).unwrap_or(0)
            - i128::from(self.settled_secs) * 1_000_000_000;
        self.files.iter().all(|file| {
            let is_old = file.changed_ns.max(file.modified_ns) < settled;
            let same = Stamp::of(&folder.join(&file.name)).is_ok_and(|found| found == *file);
            is_old && same
        })
    }
}

impl Stamp {
    fn of(path: &Path) -> Result<Stamp> {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let data =
            std::fs::metadata(path).with_context(|| format!("cannot read {}", path.display()))?;
        let nanoseconds =
            |secs: i64, nanos: i64| i128::from(secs) * 1_000_000_000 + i128::from(nanos);
        Ok(Stamp {
            name,
            bytes: data.len(),
            modified_ns: nanoseconds(data.mtime(), data.mtime_nsec()),
            changed_ns: nanoseconds(data.ctime(), data.ctime_nsec()),
        })
    }
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
