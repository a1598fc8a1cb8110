//! Lists of pinned Python packages: compares them with an environment and installs them.

use std::fs::File;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use anyhow::{Context, Error, Result, anyhow, ensure};

use super::installation::{Installation, Missing};
use super::python::{PythonEnvironment, last_lines};
use super::system_packages::{PYTHON_PACKAGES, install_missing};
use super::variables;

/// The oldest Python that the locked packages support.
const PYTHON_VERSION_MIN: (u32, u32) = (3, 10);
/// Tried in this order; the first one that is new enough is used.
const PYTHON_NAMES: [&str; 7] =
    ["python3", "python3.14", "python3.13", "python3.12", "python3.11", "python3.10", "python"];
/// The versions that uv may select, or download if there is none.
const PYTHON_VERSIONS_OF_UV: &str = ">=3.10,<3.15";
const PIP_INSTALL: [&str; 6] =
    ["install", "--quiet", "--no-input", "--disable-pip-version-check", "--require-hashes", "-r"];
/// What pip and uv print where they reach no package index.
const NETWORK_WORDS: [&str; 7] = [
    "ConnectTimeoutError",
    "Could not connect",
    "Failed to establish a new connection",
    "Network is unreachable",
    "ProxyError",
    "dns error",
    "error sending request",
];
/// Prints the packages that differ from a list. Lines with a condition are for other platforms or
/// Python versions.
const COMPARE_PACKAGES: &str = r"
import re, sys
from importlib import metadata
wrong = []
for line in open(sys.argv[1], encoding='utf-8'):
    match = re.match(r'([A-Za-z0-9._-]+)==([^\s;]+) \\$', line.rstrip())
    if match is None:
        continue
    name, expected = match.groups()
    try:
        found = metadata.version(name)
    except metadata.PackageNotFoundError:
        found = 'none'
    if found != expected:
        wrong.append(f'{name} (expected {expected}, found {found})')
print(', '.join(wrong))
";

/// A list of packages and its environment.
pub(super) struct PackageList<'a> {
    pub(super) installation: &'a Installation,
    pub(super) environment: &'a PythonEnvironment,
    pub(super) folder: &'a Path,
    pub(super) lock: &'a Path,
}

impl PackageList<'_> {
    /// Installs the packages once. A stamp file per list records that it is installed, because the
    /// packages of the tests are installed and removed independently of those of the servers.
    ///
    /// `try_out` must succeed before the installation counts as done.
    pub(super) fn install_once(
        &self,
        digest: &str,
        try_out: impl FnOnce() -> Result<()>,
    ) -> Result<()> {
        let name = self.lock.file_stem().context("a list of packages has a name")?;
        let stamp = self.folder.join(name).with_extension("installed");
        let is_installed = || {
            self.environment.python.exists()
                && std::fs::read_to_string(&stamp).is_ok_and(|found| found == digest)
        };
        if is_installed() {
            return Ok(());
        }
        let _guard = lock_folder(self.folder)?;
        // Another process may have installed it in the meantime.
        if is_installed() {
            return Ok(());
        }
        let start = Instant::now();
        eprintln!("installing Python packages into {} (once)", self.folder.display());
        self.install().map_err(explain_network)?;
        try_out()?;
        std::fs::write(&stamp, digest)
            .with_context(|| format!("cannot write {}", stamp.display()))?;
        eprintln!("installed in {:.0} s", start.elapsed().as_secs_f64());
        Ok(())
    }

    /// Fails with the packages that differ from the list and the command that installs them.
    pub(super) fn compare(&self) -> Result<()> {
        let python = self.environment.python.display();
        ensure!(
            self.environment.python.exists(),
            "there is no Python environment {python}; install with: {}",
            self.line()
        );
        let output =
            self.environment.command().args(["-c", COMPARE_PACKAGES]).arg(self.lock).output();
        let output = output.with_context(|| format!("cannot start {python}"))?;
        ensure!(output.status.success(), "{python}: {}", last_lines(&output));
        let wrong = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        ensure!(
            wrong.is_empty(),
            "{python}: packages differ: {wrong}; install with: {}",
            self.line()
        );
        Ok(())
    }

    /// Installs with uv if it is available, which takes seconds. Otherwise, or if uv fails,
    /// installs with venv and pip: these have their own configuration, so pip may know a package
    /// index that uv does not.
    fn install(&self) -> Result<()> {
        if self.finds_uv() {
            match self.install_with_uv() {
                Ok(()) => return Ok(()),
                Err(error) => eprintln!("uv failed, trying pip: {error:#}"),
            }
        }
        if !self.has_pip() {
            self.create_environment()?;
        }
        self.run(
            self.command(&self.environment.python)
                .args(["-m", "pip"])
                .args(PIP_INSTALL)
                .arg(self.lock),
        )
    }

    fn install_with_uv(&self) -> Result<()> {
        if !self.environment.python.exists() {
            let mut venv = self.command(Path::new("uv"));
            venv.args(["venv", "--quiet", "--seed", "--allow-existing"]);
            self.run(venv.args(["--python", PYTHON_VERSIONS_OF_UV]).arg(self.folder))?;
        }
        let mut install = self.command(Path::new("uv"));
        install.args(["pip", "install", "--quiet", "--compile-bytecode", "--require-hashes"]);
        install.arg("--python").arg(&self.environment.python);
        self.run(install.arg("-r").arg(self.lock))
    }

    fn has_pip(&self) -> bool {
        let mut pip = self.command(&self.environment.python);
        pip.args(["-m", "pip", "--version"]).output().is_ok_and(|output| output.status.success())
    }

    fn create_environment(&self) -> Result<()> {
        let attempt = |python: &str| {
            self.run(self.command(Path::new(python)).args(["-m", "venv"]).arg(self.folder))
        };
        let (major, minor) = PYTHON_VERSION_MIN;
        let python = self.find_python();
        let first = match python {
            Some(python) => attempt(python),
            None => Err(anyhow!("found no Python {major}.{minor} or newer")),
        };
        let Err(error) = first else { return Ok(()) };
        // The second attempt completes a folder that the first one left incomplete.
        let variables = &self.installation.host.variables;
        let is_installed = install_missing(&PYTHON_PACKAGES, variables, Missing::Install)
            .with_context(|| format!("cannot create a Python environment ({error:#})"))?;
        if !is_installed {
            return Err(error);
        }
        let python = self.find_python().with_context(|| {
            format!("this system's python3 is older than {major}.{minor}; add a newer one to PATH")
        })?;
        attempt(python)
    }

    fn find_python(&self) -> Option<&'static str> {
        PYTHON_NAMES.into_iter().find(|name| {
            let (major, minor) = PYTHON_VERSION_MIN;
            let check = format!("import sys; sys.exit(sys.version_info[:2] < ({major}, {minor}))");
            let mut python = self.command(Path::new(name));
            python.args(["-c", &check]).output().is_ok_and(|output| output.status.success())
        })
    }

    fn finds_uv(&self) -> bool {
        let mut uv = self.command(Path::new("uv"));
        uv.arg("--version").output().is_ok_and(|output| output.status.success())
    }

    fn command(&self, program: &Path) -> Command {
        let mut command = Command::new(program);
        command.env_clear();
        command.envs(variables::for_installer(&self.installation.host.variables));
        command
    }

    fn run(&self, command: &mut Command) -> Result<()> {
        let program = command.get_program().to_owned();
        let output =
            command.output().with_context(|| format!("cannot start {}", program.display()))?;
        ensure!(
            output.status.success(),
            "{} failed with {}\n{}",
            program.display(),
            output.status,
            last_lines(&output)
        );
        Ok(())
    }

    /// The command that a user can run to install the packages.
    fn line(&self) -> String {
        if self.installation.is_temporary() {
            return "rever demo --episodes 1".to_owned();
        }
        let (folder, lock) = (self.folder.display(), self.lock.display());
        let needs_python = self.find_python().is_none();
        if self.finds_uv() {
            let python = self.environment.python.display();
            return format!(
                "uv venv --seed --allow-existing --python '{PYTHON_VERSIONS_OF_UV}' {folder} && \
                 uv pip install --python {python} --require-hashes -r {lock}"
            );
        }
        let packages = PYTHON_PACKAGES.join(" ");
        let first = format!("sudo apt-get install -y {packages} && ");
        let first = if needs_python { first.as_str() } else { "" };
        format!(
            "{first}python3 -m venv {folder} && {folder}/bin/python -m pip install --require-hashes -r {lock}"
        )
    }
}

/// Says plainly that the network is missing, in place of what the installer printed for each of its attempts.
fn explain_network(error: Error) -> Error {
    let said = format!("{error:#}");
    let mut found = said.lines().filter_map(|line| {
        NETWORK_WORDS.iter().find_map(|word| line.find(word).map(|start| line[start..].trim_end()))
    });
    let Some(cause) = found.next() else { return error };
    anyhow!(
        "cannot reach a package index: is this machine offline? The first start downloads Python packages (HTTPS_PROXY \
         names a proxy, PIP_INDEX_URL another index); --python names a Python that has them already ({cause})"
    )
}

/// The lock is held until the returned file is closed, so that two processes never install into the
/// same folder at the same time.
fn lock_folder(folder: &Path) -> Result<File> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot create {}", folder.display()))?;
    let path = folder.join("setup.lock");
    let file = File::create(&path).with_context(|| format!("cannot create {}", path.display()))?;
    if file.try_lock().is_err() {
        eprintln!("waiting for another process that installs into {}", folder.display());
        file.lock().with_context(|| format!("cannot lock {}", path.display()))?;
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::os::unix::fs::PermissionsExt;

    use tempfile::TempDir;

    use super::super::installation::Host;
    use super::*;

    /// Records its arguments. `venv` creates an interpreter that does the same under its own name.
    const UV: &str = r#"#!/bin/sh
echo uv "$@" >> "$NOTES"
for last; do :; done
if [ "$1" = venv ]; then mkdir -p "$last/bin"; cp "$0" "$last/bin/python"; fi
"#;
    const PYTHON: &str = r#"#!/bin/sh
echo python "$@" >> "$NOTES"
for last; do :; done
if [ "$2" = venv ]; then mkdir -p "$last/bin"; cp "$0" "$last/bin/python"; fi
"#;
    const BROKEN: &str = "#!/bin/sh\n[ \"$1\" = --version ]\n";

    /// A machine that has only these programs.
    fn machine(programs: &[(&str, &str)]) -> (TempDir, Installation) {
        let folder = tempfile::tempdir().unwrap();
        let bin = folder.path().join("bin");
        std::fs::create_dir(&bin).unwrap();
        for (name, script) in programs {
            std::fs::write(bin.join(name), script).unwrap();
            let mode = std::fs::Permissions::from_mode(0o755);
            std::fs::set_permissions(bin.join(name), mode).unwrap();
        }
        for name in ["cp", "mkdir"] {
            std::os::unix::fs::symlink(Path::new("/bin").join(name), bin.join(name)).unwrap();
        }
        let variables = [("PATH", bin), ("NOTES", folder.path().join("notes"))];
        let variables = variables.map(|(name, value)| (name.into(), value.into()));
        let host = Host { variables: BTreeMap::from(variables), ..Host::default() };
        std::fs::write(folder.path().join("list.lock"), "").unwrap();
        let installation = Installation::checkout(folder.path(), &host);
        (folder, installation)
    }

    /// Installs the list twice; returns the programs' arguments and whether the stamp exists.
    fn install(folder: &Path, installation: &Installation) -> (String, bool) {
        let venv = folder.join("venv");
        let environment = PythonEnvironment {
            python: venv.join("bin/python"),
            package_root: folder.to_owned(),
            variables: installation.host.variables.clone(),
        };
        let lock = folder.join("list.lock");
        let list =
            PackageList { installation, environment: &environment, folder: &venv, lock: &lock };
        list.install_once("digest", || Ok(())).unwrap();
        list.install_once("digest", || panic!("it is installed")).unwrap();
        let notes = std::fs::read_to_string(folder.join("notes")).unwrap();
        let place = format!("{}/", folder.display());
        (notes.replace(&place, ""), venv.join("list.installed").exists())
    }

    #[test]
    fn uv_installs_where_it_is_found() {
        let (folder, installation) = machine(&[("uv", UV), ("python3", PYTHON)]);
        let (asked, is_installed) = install(folder.path(), &installation);
        let expected = "uv --version\n\
            uv venv --quiet --seed --allow-existing --python >=3.10,<3.15 venv\n\
            uv pip install --quiet --compile-bytecode --require-hashes --python venv/bin/python \
            -r list.lock\n";
        assert_eq!((asked.as_str(), is_installed), (expected, true));
    }

    #[test]
    fn a_machine_without_network_is_named() {
        let pip = "python ended with exit status: 1\nWARNING: Retrying (Retry(total=0)) after connection broken by \
                   'NewConnectionError: Failed to establish a new connection: Name or service not known'\nERROR: No \
                   matching distribution found for absl-py==2.5.1";
        let said = explain_network(anyhow!(pip)).to_string();
        assert!(
            said.starts_with("cannot reach a package index: is this machine offline?"),
            "{said}"
        );
        assert!(said.contains("Name or service not known") && !said.contains("absl-py"), "{said}");
        let other = "python ended with exit status: 1\nNo space left on device";
        assert_eq!(explain_network(anyhow!(other)).to_string(), other);
    }

    #[test]
    fn pip_installs_where_uv_is_missing_or_fails() {
        for programs in [&[("python3", PYTHON)][..], &[("uv", BROKEN), ("python3", PYTHON)]] {
            let (folder, installation) = machine(programs);
            let (asked, is_installed) = install(folder.path(), &installation);
            let asked: Vec<&str> = asked.lines().filter(|line| !line.contains(" -c ")).collect();
            let expected = [
                "python -m venv venv",
                "python -m pip install --quiet --no-input --disable-pip-version-check \
                 --require-hashes -r list.lock",
            ];
            assert_eq!((&asked[..], is_installed), (&expected[..], true));
        }
    }
}
