//! The Python that a wheel installed this program into, together with the packages that servers need.
//!
//! `pip install rever-*.whl` puts the program into `PREFIX/bin`, and a record into `PREFIX/lib/pythonX.Y/site-packages`.
//! This Python provides the dependencies; the package `rever_env` itself comes from the program's own files, so that it is
//! always of the same build.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};

use super::installation::{Installation, Missing};
use super::python::{PythonEnvironment, last_lines};

/// pip records an installed wheel in the folder `rever-VERSION.dist-info`. Debian's pip has another name for its parent.
const PACKAGE_FOLDERS: [&str; 2] = ["site-packages", "dist-packages"];
const RECORD_START: &str = "rever-";
const RECORD_END: &str = ".dist-info";
/// Prints the requirements of the wheel that this Python does not meet. pip checks lower bounds on installation. Pinned
/// versions decide what a simulation computes, so that they are compared each time. A requirement with a condition belongs
/// to an extra or to an older Python.
const COMPARE_REQUIREMENTS: &str = r"
import re
from importlib import metadata
wrong = []
for requirement in metadata.requires('rever') or []:
    match = re.match(r'([A-Za-z0-9._-]+) *(?:== *([^ ;,]+))?', requirement)
    if match is None or ';' in requirement:
        continue
    name, pinned = match.groups()
    try:
        found = metadata.version(name)
    except metadata.PackageNotFoundError:
        found = 'none'
    if found == 'none' or pinned not in (None, found):
        wrong.append(f'{requirement} (found {found})')
print(', '.join(wrong))
";
/// The file beside the unpacked ones that names the Python which has rendered an image.
const RENDERED_BY: &str = "rendered-by";

/// The Python of the wheel that this program comes from. None if no wheel installed it, or if a package is missing.
pub(super) fn environment(
    installation: &Installation,
    missing: Missing,
) -> Result<Option<PythonEnvironment>> {
    let program = installation.host.program.as_deref();
    let path = installation.host.variables.get(OsStr::new("PATH")).map(OsStr::new);
    let Some(python) = program.and_then(|program| python_of(program, path)) else {
        return Ok(None);
    };
    let environment = PythonEnvironment::of_user(python, installation, missing);
    if let Err(error) = compare_requirements(&environment) {
        eprintln!(
            "the Python that rever was installed into ({}) cannot run servers: {error:#}; \
             a Python environment of rever's own is used instead",
            environment.python.display()
        );
        return Ok(None);
    }
    if missing == Missing::Install {
        ensure_rendering_once(&environment, installation)?;
    }
    Ok(Some(environment))
}

/// Beside the program; on PATH if pip keeps programs apart from their Python, as `pip install --user` does.
fn python_of(program: &Path, path: Option<&OsStr>) -> Option<PathBuf> {
    let bin = program.parent()?;
    let version = python_with_record(&bin.parent()?.join("lib"))?;
    let mut beside = [version.as_str(), "python3", "python"].map(|name| bin.join(name)).into_iter();
    beside.find(|python| python.is_file()).or_else(|| {
        let folders = std::env::split_paths(path?).map(|folder| folder.join(&version));
        folders.into_iter().find(|python| python.is_file())
    })
}

/// The name of the folder, such as `python3.12`, whose packages have rever among them.
fn python_with_record(lib: &Path) -> Option<String> {
    let names = |folder: &Path| -> Vec<String> {
        let entries = folder.read_dir().into_iter().flatten().flatten();
        entries.filter_map(|entry| entry.file_name().into_string().ok()).collect()
    };
    let has_record = |version: &String| {
        let folders = PACKAGE_FOLDERS.map(|folder| lib.join(version).join(folder));
        let mut installed = folders.iter().flat_map(|folder| names(folder));
        installed.any(|name| name.starts_with(RECORD_START) && name.ends_with(RECORD_END))
    };
    names(lib).into_iter().find(|name| name.starts_with("python3") && has_record(name))
}

fn compare_requirements(environment: &PythonEnvironment) -> Result<()> {
    let output = environment.command().args(["-c", COMPARE_REQUIREMENTS]).output();
    let output = output.context("it does not start")?;
    ensure!(output.status.success(), "{}", last_lines(&output));
    let wrong = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    ensure!(wrong.is_empty(), "packages differ: {wrong}");
    Ok(())
}

/// Installs software OpenGL if it is missing, because pip installs no system packages.
fn ensure_rendering_once(
    environment: &PythonEnvironment,
    installation: &Installation,
) -> Result<()> {
    let stamp = installation.root.join(RENDERED_BY);
    let python = environment.python.as_os_str();
    if std::fs::read(&stamp).is_ok_and(|found| found == python.as_encoded_bytes()) {
        return Ok(());
    }
    eprintln!(
        "servers use the Python that rever was installed into: {}",
        environment.python.display()
    );
    environment.ensure_rendering(installation, Missing::Install)?;
    std::fs::write(&stamp, python.as_encoded_bytes())
        .with_context(|| format!("cannot write {}", stamp.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn touch(file: &Path) {
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(file, "").unwrap();
    }

    #[test]
    fn the_python_of_a_wheel_is_beside_the_program_or_on_path() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str| folder.path().join(name);
        let find = || python_of(&file("bin/rever"), Some(file("usr").as_os_str()));
        touch(&file("bin/rever"));
        touch(&file("bin/python"));
        touch(&file("lib/python3.11/site-packages/rever_env-0.0.0.dist-info/RECORD"));
        assert_eq!(find(), None, "no wheel installed this program");
        touch(&file("lib/python3.12/dist-packages/rever-0.0.0.dist-info/RECORD"));
        assert_eq!(find(), Some(file("bin/python")));
        touch(&file("bin/python3.12"));
        assert_eq!(find(), Some(file("bin/python3.12")));
        std::fs::remove_file(file("bin/python")).unwrap();
        std::fs::remove_file(file("bin/python3.12")).unwrap();
        assert_eq!(find(), None);
        touch(&file("usr/python3.12"));
        assert_eq!(find(), Some(file("usr/python3.12")));
    }
}
