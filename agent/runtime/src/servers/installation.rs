//! Locates the program's own files: in a checkout, or embedded in the program and unpacked.
//!
//! Both have the same layout, `env-server/` and `agent/models/`, so that other code need not
//! distinguish them.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};
use flate2::read::GzDecoder;
use tempfile::TempDir;

/// Files that exist in every checkout and in every unpacked copy.
const LANDMARKS: [&str; 2] =
    ["env-server/rever_env/__main__.py", "agent/models/bridge-small/config.json"];
/// Length of the digest prefix that distinguishes builds.
const DIGEST_CHARACTERS: usize = 12;

/// The environment of the process, read once by `main`.
#[derive(Debug, Clone, Default)]
pub struct Host {
    /// Path of this program.
    pub program: Option<PathBuf>,
    /// The current working directory.
    pub folder: Option<PathBuf>,
    /// The environment variables.
    pub variables: BTreeMap<OsString, OsString>,
}

/// The files embedded in a program.
#[derive(Debug, Clone, Copy)]
pub struct Bundle {
    /// A compressed archive (`.tar.gz`) with the layout of a checkout.
    pub archive: &'static [u8],
    /// SHA-256 of the archive in hexadecimal.
    pub digest: &'static str,
}

/// How to handle missing dependencies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Missing {
    /// Install them.
    Install,
    /// Report them as an error and change nothing on this machine.
    Report,
}

/// The program's own files.
#[derive(Debug, Clone)]
pub struct Installation {
    /// The folder that holds `env-server` and `agent/models`.
    pub root: PathBuf,
    /// The environment of the process.
    pub host: Host,
    /// Folder of Python environments; `None` in a checkout.
    home: Option<PathBuf>,
    /// Files unpacked only for this process; removed with the last clone.
    temporary: Option<Arc<TempDir>>,
}

impl Installation {
    /// Finds the checkout that contains the program or the working directory, otherwise the
    /// embedded files. These are unpacked into the data folder when they are first needed, or into
    /// a temporary folder if nothing may be changed.
    pub fn find(host: &Host, bundle: &Bundle, missing: Missing) -> Result<Installation> {
        let places = [host.program.as_deref(), host.folder.as_deref()];
        let mut folders = places.into_iter().flatten().flat_map(Path::ancestors);
        if let Some(root) = folders.find(|folder| is_complete(folder)) {
            return Ok(Installation::checkout(root, host));
        }
        let home = home(&host.variables)
            .context("no folder for rever's data: set REVER_HOME or HOME to an absolute path")?;
        let root = home.join(bundle.digest.get(..DIGEST_CHARACTERS).unwrap_or(bundle.digest));
        let mut found =
            Installation { root, host: host.clone(), home: Some(home), temporary: None };
        if !is_complete(&found.root) {
            match missing {
                Missing::Install => unpack_once(bundle, &found.root)?,
                Missing::Report => {
                    let folder = Arc::new(temporary_folder()?);
                    unpack(bundle, folder.path())?;
                    found.root = folder.path().to_owned();
                    found.temporary = Some(folder);
                }
            }
        }
        Ok(found)
    }

    /// An installation in a folder that is known to be a checkout.
    pub fn checkout(root: &Path, host: &Host) -> Installation {
        Installation { root: root.to_owned(), host: host.clone(), home: None, temporary: None }
    }

    /// The checkpoint shipped with rever.
    pub fn policy_folder(&self) -> PathBuf {
        self.root.join("agent/models/bridge-small")
    }

    /// The folder of the Python package `rever_env` and its lists of packages.
    pub fn package_root(&self) -> PathBuf {
        self.root.join("env-server")
    }

    /// Whether programs can be built here.
    pub fn is_checkout(&self) -> bool {
        self.home.is_none()
    }

    /// Whether the files are removed when this process ends.
    pub fn is_temporary(&self) -> bool {
        self.temporary.is_some()
    }

    /// The folder of a Python environment: `.venv/NAME` in a checkout, otherwise one folder per
    /// list of packages, which is shared by all builds with the same list.
    pub(super) fn environment_folder(&self, name: &str, packages_digest: &str) -> PathBuf {
        let digest = packages_digest.get(..DIGEST_CHARACTERS).unwrap_or(packages_digest);
        match &self.home {
            None => self.root.join(".venv").join(name),
            Some(home) => home.join("python").join(digest),
        }
    }
}

/// The folder for the program's own data, if the environment names one.
pub fn data_folder(host: &Host) -> Option<PathBuf> {
    home(&host.variables)
}

fn is_complete(folder: &Path) -> bool {
    LANDMARKS.iter().all(|file| folder.join(file).is_file())
}

/// Follows the XDG base directory specification, which requires that relative paths are ignored.
fn home(variables: &BTreeMap<OsString, OsString>) -> Option<PathBuf> {
    let folder = |name: &str| {
        let path = variables.get(std::ffi::OsStr::new(name)).map(PathBuf::from);
        path.filter(|path| path.is_absolute())
    };
    folder("REVER_HOME")
        .or_else(|| folder("XDG_DATA_HOME").map(|data| data.join("rever")))
        .or_else(|| folder("HOME").map(|home| home.join(".local/share/rever")))
}

/// Unpacks into a temporary folder next to `root` and renames it, so that `root` is complete
/// whenever it exists.
fn unpack_once(bundle: &Bundle, root: &Path) -> Result<()> {
    let parent = root.parent().context("a folder in the data folder has a parent")?;
    let cannot = || format!("cannot unpack rever's files into {}", root.display());
    std::fs::create_dir_all(parent).with_context(cannot)?;
    let folder =
        tempfile::Builder::new().prefix(".unpacking-").tempdir_in(parent).with_context(cannot)?;
    unpack(bundle, folder.path())?;
    match std::fs::rename(folder.path(), root) {
        // Another process has unpacked the same files first.
        Err(_) if is_complete(root) => Ok(()),
        renamed => renamed.with_context(cannot),
    }
}

fn unpack(bundle: &Bundle, folder: &Path) -> Result<()> {
    let mut archive = tar::Archive::new(GzDecoder::new(bundle.archive));
    archive.set_preserve_mtime(false);
    archive
        .unpack(folder)
        .with_context(|| format!("cannot unpack rever's files into {}", folder.display()))
}

fn temporary_folder() -> Result<TempDir> {
    tempfile::Builder::new()
        .prefix("rever-files-")
        .tempdir()
        .context("cannot create a temporary folder")
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use flate2::{Compression, write::GzEncoder};

    use super::*;

    /// An archive that contains only the landmarks.
    fn bundle() -> Bundle {
        let mut archive = tar::Builder::new(GzEncoder::new(Vec::new(), Compression::fast()));
        for name in LANDMARKS {
            let mut header = tar::Header::new_gnu();
            header.set_size(1);
            header.set_mode(0o644);
            archive.append_data(&mut header, name, &b"x"[..]).unwrap();
        }
        let mut encoder = archive.into_inner().unwrap();
        encoder.flush().unwrap();
        let archive = encoder.finish().unwrap().leak();
        Bundle { archive, digest: "0123456789abcdef" }
    }

    fn host(folder: &Path) -> Host {
        let home = folder.join("home");
        Host {
            program: Some(folder.join("bin/rever")),
            folder: Some(folder.join("work")),
            variables: BTreeMap::from([("HOME".into(), home.into())]),
        }
    }

    #[test]
    fn embedded_files_are_unpacked_once_into_the_data_folder() {
        let folder = tempfile::tempdir().unwrap();
        let host = host(folder.path());
        let found = Installation::find(&host, &bundle(), Missing::Install).unwrap();
        assert_eq!(found.root, folder.path().join("home/.local/share/rever/0123456789ab"));
        assert!(is_complete(&found.root) && !found.is_checkout() && !found.is_temporary());
        let mine = found.root.join("mine");
        std::fs::write(&mine, "").unwrap();
        let again = Installation::find(&host, &bundle(), Missing::Install).unwrap();
        assert_eq!(again.root, found.root);
        assert!(mine.exists());
        let data = found.root.parent().unwrap();
        assert_eq!(data.read_dir().unwrap().count(), 1, "no partly unpacked folder is left");
    }

    #[test]
    fn nothing_is_changed_if_missing_files_are_only_reported() {
        let folder = tempfile::tempdir().unwrap();
        let found = Installation::find(&host(folder.path()), &bundle(), Missing::Report).unwrap();
        assert!(is_complete(&found.root) && found.is_temporary());
        let root = found.root.clone();
        drop(found);
        assert!(!root.exists());
        assert_eq!(folder.path().read_dir().unwrap().count(), 0);
    }

    #[test]
    fn a_checkout_around_the_program_or_the_current_folder_is_used() {
        let folder = tempfile::tempdir().unwrap();
        for place in ["bin", "work"] {
            let checkout = folder.path().join(place);
            unpack(&bundle(), &checkout).unwrap();
            let found =
                Installation::find(&host(folder.path()), &bundle(), Missing::Install).unwrap();
            assert_eq!(found.root, checkout);
            assert!(found.is_checkout());
            std::fs::remove_dir_all(checkout).unwrap();
        }
        assert_eq!(folder.path().read_dir().unwrap().count(), 0);
    }

    #[test]
    fn the_data_folder_follows_the_users_variables() {
        let check = |variables: &[(&str, &str)], expected: Option<&str>| {
            let variables = variables.iter().map(|(name, value)| (name.into(), value.into()));
            assert_eq!(home(&variables.collect()), expected.map(PathBuf::from));
        };
        check(&[], None);
        check(&[("HOME", "/a")], Some("/a/.local/share/rever"));
        check(&[("HOME", "/a"), ("XDG_DATA_HOME", "/b")], Some("/b/rever"));
        check(&[("HOME", "/a"), ("XDG_DATA_HOME", "b")], Some("/a/.local/share/rever"));
        check(&[("HOME", "/a"), ("REVER_HOME", "/c")], Some("/c"));
    }
}
