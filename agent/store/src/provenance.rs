//! The provenance of records: build, command and options.

use std::fmt;

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// The provenance of a record. Every record file contains it, so that a copied file is
/// self-describing.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// The command line, word by word.
    pub command: Vec<String>,
    /// Everything that determines the results, by name.
    pub options: Value,
    /// The program.
    pub build: Build,
}

/// Suffix of a commit whose files were modified.
const DIRTY: &str = "-dirty";

/// A build of the program. All fields are empty if the caller does not know its build.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Build {
    /// Version of the program.
    pub version: String,
    /// The checked-out commit in hexadecimal; empty for a build outside a repository.
    pub commit: String,
    /// Whether files differed from that commit.
    pub is_dirty: bool,
    /// When it was built, RFC 3339.
    pub date: String,
}

impl Build {
    /// A build from a version, a commit in the format of `git describe --always --dirty`, and a
    /// date.
    pub fn new(version: &str, described: &str, date: &str) -> Build {
        let (commit, is_dirty) = match described.strip_suffix(DIRTY) {
            Some(commit) => (commit, true),
            None => (described, false),
        };
        Build {
            version: version.to_owned(),
            commit: commit.to_owned(),
            is_dirty,
            date: date.to_owned(),
        }
    }

    /// The commit, with the suffix `-dirty` if files differed from it.
    pub fn commit_text(&self) -> String {
        let commit = if self.commit.is_empty() { "unknown" } else { &self.commit };
        format!("{commit}{}", if self.is_dirty { DIRTY } else { "" })
    }

    /// Whether both builds are known to have the same sources. Builds from modified commits may
    /// differ arbitrarily, so such a build equals only itself.
    pub fn has_sources_of(&self, other: &Build) -> bool {
        let is_clean = |build: &Build| !build.commit.is_empty() && !build.is_dirty;
        self == other || (is_clean(self) && is_clean(other) && self.commit == other.commit)
    }
}

impl fmt::Display for Build {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (version, date) = (&self.version, &self.date);
        write!(formatter, "rever {version} (commit {}, built {date})", self.commit_text())
    }
}
