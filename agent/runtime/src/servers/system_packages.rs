//! System packages, in Debian's and Ubuntu's names: which are missing, and how to install those.

use std::io::ErrorKind;
use std::process::{Command, Output};

use anyhow::{Context, Result, bail, ensure};

use super::installation::Missing;
use super::python::last_lines;

/// The same names on Debian 12 and 13 and on Ubuntu 22.04 and 24.04. `libopengl0` holds the entry
/// points that MuJoCo loads, `libegl1` the off-screen context, `libgl1-mesa-dri` the software
/// renderer.
pub const GL_PACKAGES: [&str; 3] = ["libegl1", "libopengl0", "libgl1-mesa-dri"];
/// Python itself; Debian's comes without its module venv.
pub(super) const PYTHON_PACKAGES: [&str; 2] = ["python3", "python3-venv"];

/// Installs those of the packages that this system lacks, as root with apt; whether there were any. Where that is not
/// possible or not wanted, the error is the line to run.
pub(super) fn install_missing(packages: &[&str], missing: Missing) -> Result<bool> {
    let Some(lacking) = lacking(packages)? else {
        bail!("install what this system calls {}", packages.join(" "));
    };
    if lacking.is_empty() {
        return Ok(false);
    }
    let names = lacking.join(" ");
    if missing == Missing::Report || !is_root()? {
        bail!("run: sudo apt-get install -y {names}");
    }
    eprintln!("installing the system packages {names}");
    run(Command::new("apt-get").args(["update", "-qq"]))?;
    let mut install = Command::new("apt-get");
    install.args(["install", "-y", "-qq", "--no-install-recommends"]).args(lacking);
    run(install.env("DEBIAN_FRONTEND", "noninteractive"))?;
    Ok(true)
}

/// Those that are not installed; none when this is not a system of Debian's kind.
fn lacking<'a>(packages: &[&'a str]) -> Result<Option<Vec<&'a str>>> {
    let mut lacking = Vec::new();
    for package in packages {
        let mut query = Command::new("dpkg-query");
        query.args(["--show", "--showformat", "${db:Status-Status}", package]);
        let Some(output) = run_if_found(&mut query)? else { return Ok(None) };
        // A package that dpkg has never heard of is an error of its own.
        if !output.status.success() || output.stdout != b"installed" {
            lacking.push(*package);
        }
    }
    Ok(Some(lacking))
}

fn is_root() -> Result<bool> {
    let user = run_if_found(Command::new("id").arg("-u"))?;
    Ok(user.is_some_and(|output| output.stdout.trim_ascii() == b"0"))
}

fn run(command: &mut Command) -> Result<()> {
    let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
    ensure!(
        output.status.success(),
        "{command:?} ended with {}\n{}",
        output.status,
        last_lines(&output)
    );
    Ok(())
}

/// None when there is no such program.
fn run_if_found(command: &mut Command) -> Result<Option<Output>> {
    match command.output() {
        Ok(output) => Ok(Some(output)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error).with_context(|| format!("cannot start {command:?}")),
    }
}
