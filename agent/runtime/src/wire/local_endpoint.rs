//! An endpoint for this machine only: a socket in a folder that only this user can open.

use std::fs::{File, Permissions};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;
use std::time::Duration;

use anyhow::Context;
use rustix::fs::{FlockOperation, flock};
use rustix::process::geteuid;
use tempfile::TempDir;

/// Placeholder for a free loopback port.
pub(super) const ANY_LOOPBACK_PORT: &str = "tcp/127.0.0.1:0";
/// Maximum length of a socket path; the operating system's limit is 104 or 108 including the suffix
/// of zenoh's lock file.
const SOCKET_PATH_BYTES_MAX: usize = 96;
const FOLDER_PREFIX: &str = "rever-";
const SOCKET: &str = "zenoh";
/// The file that zenoh locks while it listens on the socket.
const LOCK: &str = "zenoh.lock";
/// A younger folder may belong to a process that has not locked it yet.
const AGE_MIN: Duration = Duration::from_secs(60);

/// The endpoint and its folder, or a port if the path is too long for a socket address.
pub(super) fn local_endpoint(parent: &Path) -> anyhow::Result<(String, Option<TempDir>)> {
    remove_stale_folders(parent, AGE_MIN);
    let mut folder = tempfile::Builder::new();
    folder.prefix(FOLDER_PREFIX).permissions(Permissions::from_mode(0o700));
    let folder =
        folder.tempdir_in(parent).context("cannot create a temporary folder for a socket")?;
    let socket = folder.path().join(SOCKET);
    // These characters start an endpoint's parameters, so an address must not contain them.
    let fits = |path: &&str| path.len() <= SOCKET_PATH_BYTES_MAX && !path.contains(['?', '#', ';']);
    Ok(match socket.to_str().filter(fits) {
        Some(path) => (format!("unixsock-stream/{path}"), Some(folder)),
        None => (ANY_LOOPBACK_PORT.to_owned(), None),
    })
}

/// Removes the folders of killed processes, whose locks are free.
fn remove_stale_folders(parent: &Path, age_min: Duration) {
    let Ok(entries) = parent.read_dir() else { return };
    for entry in entries.flatten() {
        let folder = entry.path();
        let is_named_so = entry.file_name().to_string_lossy().starts_with(FOLDER_PREFIX);
        // Other users may create links in a shared temporary folder.
        let is_own =
            entry.metadata().is_ok_and(|data| data.is_dir() && data.uid() == geteuid().as_raw());
        if !(is_named_so && is_own) {
            continue;
        }
        let Ok(lock) = File::open(folder.join(LOCK)) else { continue };
        let age = lock.metadata().and_then(|data| data.modified()).map(|time| time.elapsed());
        let is_old = age.is_ok_and(|age| age.is_ok_and(|age| age >= age_min));
        if is_old && flock(&lock, FlockOperation::NonBlockingLockExclusive).is_ok() {
            // Remove only known files: a folder with other files is not ours.
            let _ = std::fs::remove_file(folder.join(SOCKET));
            let _ = std::fs::remove_file(folder.join(LOCK));
            let _ = std::fs::remove_dir(&folder);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::wire::{Network, NetworkOptions};

    #[tokio::test(flavor = "multi_thread")]
    async fn only_this_user_can_open_the_socket_and_it_is_removed_with_the_network()
    -> anyhow::Result<()> {
        let network = Network::open(NetworkOptions::default()).await?;
        let endpoint = network.listening()[0].clone();
        let socket = Path::new(endpoint.strip_prefix("unixsock-stream/").context("no socket")?);
        let folder = socket.parent().context("no folder")?;
        assert!(socket.exists());
        assert_eq!(folder.metadata()?.permissions().mode() & 0o777, 0o700);
        network.close().await?;
        assert!(!folder.exists());
        Ok(())
    }

    #[test]
    fn only_folders_of_ended_processes_are_removed() -> anyhow::Result<()> {
        let parent = tempfile::tempdir()?;
        let folder = |name: &str, files: &[&str]| -> anyhow::Result<PathBuf> {
            let folder = parent.path().join(name);
            std::fs::create_dir(&folder)?;
            files.iter().try_for_each(|file| std::fs::write(folder.join(file), ""))?;
            Ok(folder)
        };
        let dead = folder("rever-dead", &[SOCKET, LOCK])?;
        let alive = folder("rever-alive", &[SOCKET, LOCK])?;
        let lock = File::open(alive.join(LOCK))?;
        flock(&lock, FlockOperation::NonBlockingLockExclusive)?;
        let others = [
            folder("rever-new", &[])?,
            folder("rever-more", &[SOCKET, LOCK, "of the user"])?.join("of the user"),
            folder("revered", &[SOCKET, LOCK])?.join(LOCK),
        ];
        std::os::unix::fs::symlink(&others[2], parent.path().join("rever-link"))?;
        remove_stale_folders(parent.path(), Duration::from_secs(3600));
        assert!(dead.exists());
        remove_stale_folders(parent.path(), Duration::ZERO);
        assert!(!dead.exists());
        assert!(alive.join(SOCKET).exists());
        assert!(others.iter().all(|path| path.exists()));
        Ok(())
    }

    #[test]
    fn a_path_that_is_too_long_for_a_socket_gives_a_port() -> anyhow::Result<()> {
        let folder = tempfile::tempdir()?;
        let deep = folder.path().join("d".repeat(SOCKET_PATH_BYTES_MAX));
        std::fs::create_dir(&deep)?;
        assert_eq!(local_endpoint(&deep)?.0, ANY_LOOPBACK_PORT);
        assert!(local_endpoint(folder.path())?.0.starts_with("unixsock-stream/"));
        assert_eq!(deep.read_dir()?.count(), 0);
        Ok(())
    }
}
