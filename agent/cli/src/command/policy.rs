//! Loads the policy that a command line names; what cannot be used is wrong usage, with what to do.

use std::path::Path;

use anyhow::Result;
use vla::{DeviceName, Vla};

use super::WrongUsage;

/// Loads a checkpoint's folder onto a device.
pub fn load(folder: &Path, device: DeviceName) -> Result<Vla> {
    let name = folder.display();
    if !folder.is_dir() {
        return Err(WrongUsage(format!(
            "--policy: expected a checkpoint's folder, got {name}, which is none; a checkpoint on the Hugging Face Hub is \
             downloaded with `hf download OWNER/NAME --local-dir FOLDER`"
        ))
        .into());
    }
    Vla::load(folder, device).map_err(|error| WrongUsage(format!("{error:#}")).into())
}
