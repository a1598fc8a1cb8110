//! How records came about: by which build, with which command and options.

use std::fmt;

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// How a record came about. Every record's file holds it, so that a record explains itself wherever it is copied to.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Provenance {
    /// The command line, word by word.
    pub command: Vec<String>,
    /// Everything that decides the results, by name.
    pub options: Value,
    /// The program.
    pub build: Build,
}

/// Follows a commit from which files differed.
const DIRTY: &str = "-dirty";

/// A build of the program; all fields are empty where the caller does not know its own.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Build {
    /// Of the program.
    pub version: String,
    /// The commit that was checked out, hexadecimal; empty for a build outside a repository.
    pub commit: String,
    /// Whether something differed from that commit.
    pub is_dirty: bool,
    /// When it was built, RFC 3339.
    pub date: String,
}

impl Build {
    /// Of a version, a commit as `git describe --always --dirty` writes it, and a date.
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

    /// The commit, with `-dirty` when something differed from it.
    pub fn commit_text(&self) -> String {
        let commit = if self.commit.is_empty() { "unknown" } else { &self.commit };
        format!("{commit}{}", if self.is_dirty { DIRTY } else { "" })
    }

    /// Whether both are known to be built from the same sources. Two builds from a changed commit may differ in anything, so
    /// only a build itself is the same as one of those.
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
