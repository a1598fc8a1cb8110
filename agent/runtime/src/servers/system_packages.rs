//! System packages with Debian's and Ubuntu's names: finds missing ones and installs them.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::io::ErrorKind;
use std::process::{Command, Output};

use anyhow::{Context, Result, bail, ensure};

use super::installation::Missing;
use super::python::last_lines;

type Variables = BTreeMap<OsString, OsString>;

/// The names are the same on Debian 12 and 13 and on Ubuntu 22.04 and 24.04. `libopengl0` has the
/// entry points that MuJoCo loads, `libegl1` the off-screen context, `libgl1-mesa-dri` the software
/// renderer.
pub const GL_PACKAGES: [&str; 3] = ["libegl1", "libopengl0", "libgl1-mesa-dri"];
/// Python itself; Debian packages its venv module separately.
pub(super) const PYTHON_PACKAGES: [&str; 2] = ["python3", "python3-venv"];

/// Installs missing packages with apt, as root; returns whether there were any. If that is
/// impossible or not wanted, the error contains the command to run. `variables` are the environment
/// variables of all commands.
pub fn install_missing(packages: &[&str], variables: &Variables, missing: Missing) -> Result<bool> {
    let Some(lacking) = lacking(packages, variables)? else {
        bail!("install this system's equivalents of the Debian packages {}", packages.join(" "));
    };
    if lacking.is_empty() {
        return Ok(false);
    }
    let names = lacking.join(" ");
    if missing == Missing::Report || !is_root(variables)? {
        bail!("run: sudo apt-get install -y {names}");
    }
    eprintln!("installing the system packages {names}");
    run(command("apt-get", variables).args(["update", "-qq"]))?;
    let mut install = command("apt-get", variables);
    install.args(["install", "-y", "-qq", "--no-install-recommends"]).args(lacking);
    run(install.env("DEBIAN_FRONTEND", "noninteractive"))?;
    Ok(true)
}

/// The packages that are not installed; `None` if this is not a Debian-based system.
fn lacking<'a>(packages: &[&'a str], variables: &Variables) -> Result<Option<Vec<&'a str>>> {
    let mut lacking = Vec::new();
    for package in packages {
        let mut query = command("dpkg-query", variables);
        query.args(["--show", "--showformat", "${db:Status-Status}", package]);
        let Some(output) = run_if_found(&mut query)? else { return Ok(None) };
        // dpkg-query fails for a package that it does not know.
        if !output.status.success() || output.stdout != b"installed" {
            lacking.push(*package);
        }
    }
    Ok(Some(lacking))
}

fn is_root(variables: &Variables) -> Result<bool> {
    let user = run_if_found(command("id", variables).arg("-u"))?;
    Ok(user.is_some_and(|output| output.stdout.trim_ascii() == b"0"))
}

fn command(program: &str, variables: &Variables) -> Command {
    let mut command = Command::new(program);
    command.env_clear().envs(variables);
    command
}

fn run(command: &mut Command) -> Result<()> {
    let name = name_of(command);
    let output = command.output().with_context(|| format!("cannot start {name}"))?;
    ensure!(
        output.status.success(),
        "{name} failed with {}\n{}",
        output.status,
        last_lines(&output)
    );
    Ok(())
}

/// `None` if the program does not exist.
fn run_if_found(command: &mut Command) -> Result<Option<Output>> {
    match command.output() {
        Ok(output) => Ok(Some(output)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error).with_context(|| format!("cannot start {}", name_of(command))),
    }
}

/// The command as a user would type it, without its environment variables.
fn name_of(command: &Command) -> String {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    words.map(|word| word.to_string_lossy()).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    const APT: &str = "echo \"$@\" >> \"$NOTES\"";
    /// One package is installed, one was removed, and dpkg does not know the third.
    const DPKG: &str =
        "case \"$4\" in one) printf installed;; two) printf config-files;; *) exit 1;; esac";

    /// The result on a machine with these programs, and the arguments of apt.
    fn install(
        programs: &[(&str, &str)],
        packages: &[&str],
        missing: Missing,
    ) -> (Result<bool, String>, String) {
        let folder = tempfile::tempdir().unwrap();
        for (name, script) in programs {
            let program = folder.path().join(name);
            std::fs::write(&program, format!("#!/bin/sh\n{script}\n")).unwrap();
            let mode = std::fs::Permissions::from_mode(0o755);
            std::fs::set_permissions(&program, mode).unwrap();
        }
        let notes = folder.path().join("notes");
        let variables = [("PATH", folder.path().to_owned()), ("NOTES", notes.clone())];
        let variables = variables.map(|(name, value)| (name.into(), value.into()));
        let answer = install_missing(packages, &BTreeMap::from(variables), missing);
        let asked = std::fs::read_to_string(notes).unwrap_or_default();
        (answer.map_err(|error| format!("{error:#}")), asked)
    }

    #[test]
    fn only_missing_packages_are_installed_and_only_by_root() {
        let root = [("dpkg-query", DPKG), ("apt-get", APT), ("id", "echo 0")];
        let user = [("dpkg-query", DPKG), ("apt-get", APT), ("id", "echo 1000")];
        let (all, line) = (["one", "two", "three"], "run: sudo apt-get install -y two three");
        let (answer, asked) = install(&root, &all, Missing::Install);
        assert_eq!(answer, Ok(true));
        let expected = "update -qq\ninstall -y -qq --no-install-recommends two three\n";
        assert_eq!(asked, expected);
        let nothing = String::new();
        assert_eq!(install(&root, &["one"], Missing::Install), (Ok(false), nothing.clone()));
        let refused = (Err(line.to_owned()), nothing.clone());
        assert_eq!(install(&user, &all, Missing::Install), refused);
        assert_eq!(install(&root, &all, Missing::Report), refused);
        let (answer, _) = install(&[("id", "echo 0")], &all, Missing::Install);
        assert_eq!(
            answer,
            Err("install this system's equivalents of the Debian packages one two three".to_owned())
        );
    }
}
