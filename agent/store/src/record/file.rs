//! The file of a record: the record, its provenance, and a checksum of both.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use serde_bytes::Bytes;
use sha2::{Digest, Sha256};

use super::{EpisodeRecord, RECORD_VERSION};
use crate::durable::write_whole;
use crate::provenance::Provenance;

/// Versions of the format without a checksum.
const VERSIONS_WITHOUT_CHECKSUM: std::ops::RangeInclusive<u32> = 1..=3;

/// The content of a file.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordFile {
    /// The provenance of the record.
    pub provenance: Provenance,
    /// The record.
    pub record: EpisodeRecord,
}

/// Why a record could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// An I/O error; the record may be intact.
    #[error("cannot read the record {path}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The operating system's error.
        source: std::io::Error,
    },
    /// Intact, but written in another version of the format.
    #[error("{path}: expected record version {RECORD_VERSION}, got {found}")]
    OtherVersion {
        /// The file.
        path: PathBuf,
        /// The version of the file, or how its fields differ.
        found: String,
    },
    /// The file's content has changed since it was written.
    #[error("{path}: damaged: {reason}; rerun the command of its run to repeat the episode")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What was expected and what was found.
        reason: String,
    },
}

/// The file's layout. Both parts are MessagePack themselves, so that the checksum covers bytes.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Envelope<'a> {
    version: u32,
    #[serde(borrow)]
    sha256: &'a Bytes,
    #[serde(borrow)]
    provenance: &'a Bytes,
    #[serde(borrow)]
    record: &'a Bytes,
}

/// The field that files of all versions have.
#[derive(Deserialize)]
struct Versioned {
    version: u32,
}

impl EpisodeRecord {
    /// Writes the record atomically: after any interruption the file is complete or absent.
    pub fn write(&self, path: &Path, provenance: &Provenance) -> Result<()> {
        let record = rmp_serde::to_vec_named(self).context("cannot encode the record")?;
        let provenance =
            rmp_serde::to_vec_named(provenance).context("cannot encode the provenance")?;
        let sha256 = checksum(self.version, &provenance, &record);
        let envelope = Envelope {
            version: self.version,
            sha256: Bytes::new(&sha256),
            provenance: Bytes::new(&provenance),
            record: Bytes::new(&record),
        };
        let bytes = rmp_serde::to_vec_named(&envelope).context("cannot encode the record")?;
        write_whole(path, &bytes)
    }

    /// Reads a record and verifies its checksum.
    pub fn read(path: &Path) -> Result<EpisodeRecord, ReadError> {
        Ok(RecordFile::read(path)?.record)
    }
}

impl RecordFile {
    /// Reads a file and verifies its checksum.
    pub fn read(path: &Path) -> Result<RecordFile, ReadError> {
        let bytes = std::fs::read(path)
            .map_err(|source| ReadError::Unreadable { path: path.to_owned(), source })?;
        RecordFile::decode(&bytes, path)
    }

    fn decode(bytes: &[u8], path: &Path) -> Result<RecordFile, ReadError> {
        let damaged = |reason: String| ReadError::Damaged { path: path.to_owned(), reason };
        let other = |found: String| ReadError::OtherVersion { path: path.to_owned(), found };
        let envelope: Envelope<'_> = match rmp_serde::from_slice(bytes) {
            Ok(envelope) => envelope,
            Err(error) => {
                return Err(match version(bytes) {
                    Some(version) if version != RECORD_VERSION => other(version.to_string()),
                    _ => damaged(format!("expected an episode record, got {error}")),
                });
            }
        };
        // The checksum does not cover bytes after the envelope and alternative encodings of the
        // envelope.
        if rmp_serde::to_vec_named(&envelope).ok().as_deref() != Some(bytes) {
            return Err(damaged("expected exactly one record".to_owned()));
        }
        let Envelope { version, sha256, provenance, record } = envelope;
        if checksum(version, provenance, record) != **sha256 {
            return Err(damaged("its checksum does not match".to_owned()));
        }
        if version != RECORD_VERSION {
            return Err(other(version.to_string()));
        }
        // A build with other fields is not damage.
        let differs = |error| other(format!("{version} with other fields: {error}"));
        let provenance = rmp_serde::from_slice(provenance).map_err(differs)?;
        let record: EpisodeRecord = rmp_serde::from_slice(record).map_err(differs)?;
        Ok(RecordFile { provenance, record })
    }
}

/// The version of an intact file in another format; `None` for a damaged file.
fn version(mut bytes: &[u8]) -> Option<u32> {
    let Versioned { version } = rmp_serde::from_read(&mut bytes).ok()?;
    let is_other = VERSIONS_WITHOUT_CHECKSUM.contains(&version) || version > RECORD_VERSION;
    (bytes.is_empty() && is_other).then_some(version)
}

fn checksum(version: u32, provenance: &[u8], record: &[u8]) -> [u8; 32] {
    Sha256::new()
        .chain_update(version.to_le_bytes())
        .chain_update((provenance.len() as u64).to_le_bytes())
        .chain_update(provenance)
        .chain_update(record)
        .finalize()
        .into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::provenance::Build;
    use crate::record::tests::made_up;
    use serde_json::json;

    fn provenance() -> Provenance {
        Provenance {
            command: vec!["rever".into(), "evaluate".into()],
            options: json!({"seed": 7, "settings": ["greedy"]}),
            build: Build { commit: "f00d".into(), ..Build::default() },
        }
    }

    fn bytes_of(record: &EpisodeRecord) -> Vec<u8> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.msgpack");
        record.write(&path, &provenance()).expect("written");
        let count = std::fs::read_dir(folder.path()).expect("a folder").count();
        assert_eq!(count, 1, "no temporary is left");
        std::fs::read(&path).expect("read")
    }

    fn decode(bytes: &[u8]) -> Result<RecordFile, ReadError> {
        RecordFile::decode(bytes, Path::new("a.msgpack"))
    }

    #[test]
    fn a_record_is_read_back_with_its_provenance() {
        let file = decode(&bytes_of(&made_up(3))).expect("whole");
        assert_eq!(file, RecordFile { provenance: provenance(), record: made_up(3) });
    }

    #[test]
    fn any_flipped_bit_is_detected() {
        let bytes = bytes_of(&made_up(0));
        for index in 0..bytes.len() {
            for bit in 0..8 {
                let mut flipped = bytes.clone();
                flipped[index] ^= 1 << bit;
                let error = decode(&flipped).expect_err("one bit differs");
                assert!(matches!(error, ReadError::Damaged { .. }), "byte {index}: {error}");
            }
        }
    }

    #[test]
    fn a_record_with_missing_or_extra_bytes_is_damaged() {
        let bytes = bytes_of(&made_up(0));
        for length in 0..bytes.len() {
            let error = decode(&bytes[..length]).expect_err("it ends early");
            assert!(matches!(error, ReadError::Damaged { .. }), "{length} bytes: {error}");
        }
        let error = decode(&[&bytes[..], &[0]].concat()).expect_err("one byte more");
        let expected = "a.msgpack: damaged: expected exactly one record; rerun the command";
        assert!(error.to_string().starts_with(expected), "{error}");
    }

    #[test]
    fn records_of_other_versions_are_refused_and_not_damaged() {
        let check = |bytes: &[u8], expected: &str| {
            let error = decode(bytes).expect_err(expected);
            assert!(matches!(error, ReadError::OtherVersion { .. }), "{error}");
            assert!(error.to_string().contains(expected), "{error}");
        };
        let later = EpisodeRecord { version: 5, ..made_up(0) };
        check(&bytes_of(&later), "expected record version 4, got 5");
        // Versions without a checksum, and a future one.
        for version in [1, 2, 3, 6] {
            let other = json!({"version": version, "steps": [{"log_probability": -3.5}]});
            let bytes = rmp_serde::to_vec_named(&other).expect("bytes");
            check(&bytes, &format!("expected record version 4, got {version}"));
        }
        // The same version, from a build with other fields.
        let (provenance, record) =
            (rmp_serde::to_vec_named(&provenance()).expect("bytes"), vec![0x80]);
        let sha256 = checksum(RECORD_VERSION, &provenance, &record);
        let envelope = Envelope {
            version: RECORD_VERSION,
            sha256: Bytes::new(&sha256),
            provenance: Bytes::new(&provenance),
            record: Bytes::new(&record),
        };
        let bytes = rmp_serde::to_vec_named(&envelope).expect("bytes");
        check(&bytes, "got 4 with other fields: missing field `version`");
    }
}
