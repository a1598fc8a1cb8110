//! tasks.toml and the scenes, from a folder or built into the program.

use std::path::PathBuf;

use anyhow::{Context, Result};
use include_dir::{Dir, include_dir};

static BUILT_IN: Dir<'_> = include_dir!("$CARGO_MANIFEST_DIR/../assets");

/// Where the assets are read from.
#[derive(Debug, Clone)]
pub enum Assets {
    Folder(PathBuf),
    BuiltIn,
}

impl Assets {
    /// The content of a file.
    pub fn text(&self, name: &str) -> Result<String> {
        match self {
            Assets::Folder(folder) => {
                let path = folder.join(name);
                std::fs::read_to_string(&path)
                    .with_context(|| format!("cannot read {}", path.display()))
            }
            Assets::BuiltIn => {
                let file = BUILT_IN.get_file(name).and_then(|file| file.contents_utf8());
                let text = file.with_context(|| format!("the built-in assets have no {name}"))?;
                Ok(text.to_owned())
            }
        }
    }
}
