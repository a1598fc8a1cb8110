//! `rever completions` and `rever man`: generate shell completions and man pages.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::{Args, CommandFactory};
use clap_complete::Shell;

use super::Program;

/// Print a completion script for a shell
#[derive(Debug, Args)]
#[command(after_help = "Example:
  rever completions bash > ~/.local/share/bash-completion/completions/rever")]
pub struct CompletionsArguments {
    /// Shell to generate the script for
    shell: Shell,
}

/// Write man pages, one per command
#[derive(Debug, Args)]
#[command(after_help = "Example:
  rever man ~/.local/share/man/man1 && man rever-evaluate")]
pub struct ManArguments {
    /// Folder to write to; created if it does not exist
    folder: PathBuf,
}

/// Prints the script.
pub fn run(arguments: &CompletionsArguments) -> Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut Program::command(), "rever", &mut script);
    print!("{}", String::from_utf8(script)?);
    Ok(())
}

/// Writes the pages.
pub fn write_pages(arguments: &ManArguments) -> Result<()> {
    let folder = &arguments.folder;
    let write = || -> std::io::Result<()> {
        std::fs::create_dir_all(folder)?;
        clap_mangen::generate_to(Program::command(), folder)
    };
    write().with_context(|| format!("cannot write man pages to {}", folder.display()))?;
    println!("man pages: {}", folder.display());
    Ok(())
}
