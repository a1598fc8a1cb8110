//! Loads the policy of `--policy`. A folder that cannot be used is wrong usage; the message says what to do.

use std::path::Path;

use anyhow::Result;
use vla::{DeviceName, Vla};

use super::WrongUsage;

/// Loads a checkpoint onto a device.
pub fn load(folder: &Path, device: DeviceName) -> Result<Vla> {
    let name = folder.display();
    if !folder.is_dir() {
        return Err(WrongUsage(format!(
            "--policy: expected a checkpoint's folder, but {name} is not a folder; download a checkpoint from the \
             Hugging Face Hub with `hf download OWNER/NAME --local-dir FOLDER`"
        ))
        .into());
    }
    Vla::load(folder, device).map_err(|error| WrongUsage(format!("{error:#}")).into())
}
