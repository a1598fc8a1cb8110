//! The program's own files: those of a checkout, or the ones that `build.rs` embeds in the program.

use std::path::PathBuf;

use anyhow::{Result, ensure};
use runtime::servers::{Bundle, Host, Installation, Missing};

const BUNDLE: Bundle = Bundle {
    archive: include_bytes!(concat!(env!("OUT_DIR"), "/files.tar.gz")),
    digest: env!("REVER_FILES_DIGEST"),
};

/// Finds them; embedded ones are unpacked into the data folder when they are first needed.
pub fn installation(host: &Host) -> Result<Installation> {
    Installation::find(host, &BUNDLE, Missing::Install)
}

/// Finds them and changes nothing on this machine.
pub fn installation_unchanged(host: &Host) -> Result<Installation> {
    Installation::find(host, &BUNDLE, Missing::Report)
}

/// The named checkpoint, or the one that comes with the program.
pub fn policy_folder(named: Option<&PathBuf>, host: &Host) -> Result<PathBuf> {
    match named {
        Some(folder) => Ok(folder.clone()),
        None => Ok(installation(host)?.policy_folder()),
    }
}

/// A file that only a checkout has.
pub fn of_checkout(host: &Host, path: &str) -> Result<PathBuf> {
    let installation = installation(host)?;
    ensure!(
        installation.is_checkout(),
        "{path}: expected to run in a checkout of rever, which has it"
    );
    Ok(installation.root.join(path))
}
