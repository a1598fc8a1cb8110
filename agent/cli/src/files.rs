//! The program's own files: from a checkout, or embedded in the program by `build.rs`.

use std::path::PathBuf;

use anyhow::{Result, ensure};
use runtime::servers::{Bundle, Host, Installation, Missing};

/// A policy's own verifier, in the policy's folder.
pub const VERIFIER_FILE: &str = "verifier.safetensors";

const BUNDLE: Bundle = Bundle {
    archive: include_bytes!(concat!(env!("OUT_DIR"), "/files.tar.gz")),
    digest: env!("REVER_FILES_DIGEST"),
};

/// Finds the files. Embedded files are unpacked into the data folder on first use.
pub fn installation(host: &Host) -> Result<Installation> {
    Installation::find(host, &BUNDLE, Missing::Install)
}

/// Finds the files without changing anything on this machine.
pub fn installation_unchanged(host: &Host) -> Result<Installation> {
    Installation::find(host, &BUNDLE, Missing::Report)
}

/// The folder of the given checkpoint, or of the one that comes with the program.
pub fn policy_folder(named: Option<&PathBuf>, host: &Host) -> Result<PathBuf> {
    match named {
        Some(folder) => Ok(folder.clone()),
        None => Ok(installation(host)?.policy_folder()),
    }
}

/// The path of a file that exists only in a checkout.
pub fn of_checkout(host: &Host, path: &str) -> Result<PathBuf> {
    let installation = installation(host)?;
    ensure!(
        installation.is_checkout(),
        "{path}: only a checkout of rever has this file; run rever from a checkout"
    );
    Ok(installation.root.join(path))
}
