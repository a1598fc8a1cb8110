//! An endpoint of this machine alone: a socket in a folder that only this user may open.

use std::fs::{File, Permissions};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;
use std::time::Duration;

use anyhow::Context;
use rustix::fs::{FlockOperation, flock};
use rustix::process::geteuid;
use tempfile::TempDir;

/// Stands for a free port of this machine alone.
pub(super) const ANY_LOOPBACK_PORT: &str = "tcp/127.0.0.1:0";
/// Of a socket in the file system; a system's own limit is 104 or 108 with the name that zenoh adds for a lock.
const SOCKET_PATH_BYTES_MAX: usize = 96;
const FOLDER_PREFIX: &str = "rever-";
const SOCKET: &str = "zenoh";
/// What zenoh locks while it listens at the socket.
const LOCK: &str = "zenoh.lock";
/// A younger folder may be of a process that is about to lock it.
const AGE_MIN: Duration = Duration::from_secs(60);

/// The endpoint and the folder that it is in, or a port where the folder's path does not fit into a socket's address.
pub(super) fn local_endpoint(parent: &Path) -> anyhow::Result<(String, Option<TempDir>)> {
    remove_stale_folders(parent, AGE_MIN);
    let mut folder = tempfile::Builder::new();
    folder.prefix(FOLDER_PREFIX).permissions(Permissions::from_mode(0o700));
    let folder = folder.tempdir_in(parent).context("no temporary folder for a socket")?;
    let socket = folder.path().join(SOCKET);
    // What begins an endpoint's parameters cannot stand in its address.
    let fits = |path: &&str| path.len() <= SOCKET_PATH_BYTES_MAX && !path.contains(['?', '#', ';']);
    Ok(match socket.to_str().filter(fits) {
        Some(path) => (format!("unixsock-stream/{path}"), Some(folder)),
        None => (ANY_LOOPBACK_PORT.to_owned(), None),
    })
}

/// Removes the folders of processes that were killed: nobody holds their locks.
fn remove_stale_folders(parent: &Path, age_min: Duration) {
    let Ok(entries) = parent.read_dir() else { return };
    for entry in entries.flatten() {
        let folder = entry.path();
        let is_named_so = entry.file_name().to_string_lossy().starts_with(FOLDER_PREFIX);
        // Anybody may put a link into a folder for temporary files.
        let is_own =
            entry.metadata().is_ok_and(|data| data.is_dir() && data.uid() == geteuid().as_raw());
        if !(is_named_so && is_own) {
            continue;
        }
        let Ok(lock) = File::open(folder.join(LOCK)) else { continue };
        let age = lock.metadata().and_then(|data| data.modified()).map(|time| time.elapsed());
        let is_old = age.is_ok_and(|age| age.is_ok_and(|age| age >= age_min));
        if is_old && flock(&lock, FlockOperation::NonBlockingLockExclusive).is_ok() {
            // Only what was put there: a folder that holds anything else is not ours.
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
    async fn the_socket_is_this_users_alone_and_goes_with_the_network() -> anyhow::Result<()> {
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
    fn folders_of_dead_processes_go_and_all_others_stay() -> anyhow::Result<()> {
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
    fn a_folder_with_too_long_a_name_for_a_socket_gives_a_port() -> anyhow::Result<()> {
        let folder = tempfile::tempdir()?;
        let deep = folder.path().join("d".repeat(SOCKET_PATH_BYTES_MAX));
        std::fs::create_dir(&deep)?;
        assert_eq!(local_endpoint(&deep)?.0, ANY_LOOPBACK_PORT);
        assert!(local_endpoint(folder.path())?.0.starts_with("unixsock-stream/"));
        assert_eq!(deep.read_dir()?.count(), 0);
        Ok(())
    }
}
