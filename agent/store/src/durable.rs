//! Atomic file writes: after any interruption a file is complete or absent. Also checks in advance
//! whether a file can be written.

use std::fs::{File, OpenOptions, Permissions};
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use anyhow::{Context, Result, ensure};

/// Prefix of unfinished files; the holder of the folder's lock may remove them.
pub(crate) const TEMPORARY_PREFIX: &str = ".tmp";

/// Free space required for a file that will be written later, in bytes.
const FREE_BYTES_MIN: usize = 1 << 20;

/// Writes a file under a temporary name, syncs it, then renames it.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let name = path.display();
    let folder = folder_of(path);
    let mut file = temporary(folder).with_context(|| format!("cannot create {name}"))?;
    file.write_all(bytes)
        .and_then(|()| file.as_file().sync_all())
        .with_context(|| format!("cannot write {name}"))?;
    file.persist(path).with_context(|| format!("cannot write {name}"))?;
    // The name is durable only after its folder is synced.
    File::open(folder)
        .and_then(|folder| folder.sync_all())
        .with_context(|| format!("cannot write {name}"))
}

/// Checks whether a file can be written or replaced at `path`, before the work that produces its
/// content. Creates the folder; does not change an existing file.
pub fn check_writable(path: &Path) -> Result<()> {
    let (name, folder) = (path.display(), folder_of(path));
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot write {name}: cannot create its folder"))?;
    if path.exists() {
        ensure!(path.is_file(), "cannot write {name}: it exists and is not a file");
        OpenOptions::new()
            .append(true)
            .open(path)
            .with_context(|| format!("cannot write {name}"))?;
    }
    // Permissions and free space can be determined reliably only by trying.
    let mut file = temporary(folder).with_context(|| format!("cannot write {name}"))?;
    file.write_all(&vec![0; FREE_BYTES_MIN]).and_then(|()| file.as_file().sync_all()).with_context(
        || format!("cannot write {name}: expected at least {FREE_BYTES_MIN} free bytes"),
    )
}

/// The file's permissions follow the umask, because runs may be on shared volumes.
fn temporary(folder: &Path) -> std::io::Result<tempfile::NamedTempFile> {
    tempfile::Builder::new()
        .prefix(TEMPORARY_PREFIX)
        .permissions(Permissions::from_mode(0o666))
        .tempfile_in(folder)
}

/// A bare file name is in the working folder.
fn folder_of(path: &Path) -> &Path {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    folder.unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checking_a_writable_path_changes_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("deep/results.json");
        check_writable(&path).expect("writable");
        assert!(!path.exists());
        write_whole(&path, b"{}").expect("written");
        check_writable(&path).expect("writable");
        assert_eq!(std::fs::read(&path).expect("a file"), b"{}");
        let names = std::fs::read_dir(path.parent().expect("a folder")).expect("a folder").count();
        assert_eq!(names, 1, "no temporary is left");
    }

    #[test]
    fn an_error_names_the_path_that_cannot_be_written() {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("file"), b"").expect("a file");
        let check = |path: &Path, expected: &str| {
            let error = format!("{:#}", check_writable(path).expect_err(expected));
            assert!(error.contains(expected), "{error}");
            assert!(error.contains(&path.display().to_string()), "{error}");
        };
        check(folder.path(), "it exists and is not a file");
        check(&folder.path().join("file/results.json"), "cannot create its folder");
        check(Path::new("/dev/full"), "it exists and is not a file");
        check(Path::new("/proc/results.json"), "cannot write /proc/results.json");
    }
}
