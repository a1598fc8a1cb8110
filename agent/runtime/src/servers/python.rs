//! Python for local servers: an environment of rever's own with pinned packages, and software OpenGL.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Instant;

use anyhow::{Context, Result, anyhow, ensure};
use sha2::{Digest, Sha256};

use super::installation::{Installation, Missing};
use super::system_packages::{GL_PACKAGES, PYTHON_PACKAGES, install_missing};
use super::variables;

/// The oldest Python that the locked packages support.
const PYTHON_VERSION_MIN: (u32, u32) = (3, 10);
/// Tried in this order; the first that is new enough is taken.
const PYTHON_NAMES: [&str; 7] =
    ["python3", "python3.14", "python3.13", "python3.12", "python3.11", "python3.10", "python"];
/// What uv may choose, or download if there is none.
const PYTHON_VERSIONS_OF_UV: &str = ">=3.10,<3.15";
const SERVERS_LOCK: &str = "requirements.lock";
const SIMULATORS_LOCK: &str = "requirements-simulators.lock";
const DEVELOPMENT_LOCK: &str = "requirements-development.lock";
const PIP_INSTALL: [&str; 6] =
    ["install", "--quiet", "--no-input", "--disable-pip-version-check", "--require-hashes", "-r"];
/// How much of a failed command's output an error repeats.
const OUTPUT_LINES_MAX: usize = 15;
/// Renders what a server renders; an image of one colour was not rendered.
const RENDER_ONE_IMAGE: &str = "
from rever_env import tasks
from rever_env.world import World
world = World(next(iter(tasks.load().values())))
image = world.reset(layout=0, seed=0).image
world.close()
assert image.max() > image.min(), 'the rendered image has one colour only'
";
/// Names what differs from a list of packages. Lines with a condition are for other machines or Pythons.
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

/// A Python that can run `-m rever_env`.
#[derive(Debug, Clone)]
pub struct PythonEnvironment {
    /// The interpreter, with the locked packages installed.
    pub python: PathBuf,
    /// The folder that holds the package `rever_env`.
    pub package_root: PathBuf,
    /// All variables that its processes see.
    pub variables: BTreeMap<OsString, OsString>,
}

impl PythonEnvironment {
    fn new(python: PathBuf, installation: &Installation, missing: Missing) -> PythonEnvironment {
        let package_root = installation.package_root();
        let mut variables = variables::for_server(&installation.host.variables);
        variables.insert("PYTHONPATH".into(), package_root.clone().into());
        if missing == Missing::Report {
            // Python and Mesa would otherwise keep what they compile.
            variables.insert("PYTHONDONTWRITEBYTECODE".into(), "1".into());
            variables.insert("MESA_SHADER_CACHE_DISABLE".into(), "true".into());
        }
        PythonEnvironment { python, package_root, variables }
    }

    /// A command for this Python, with the variables that `rever_env` needs.
    pub fn command(&self) -> Command {
        let mut command = Command::new(&self.python);
        command.env_clear().envs(&self.variables);
        command
    }

    /// Makes sure that an image can be rendered without a screen or a graphics card. System packages are installed only
    /// when that fails and some are found to be missing.
    pub fn ensure_rendering(&self, missing: Missing) -> Result<()> {
        let Err(error) = self.render_one_image() else { return Ok(()) };
        let is_installed = install_missing(&GL_PACKAGES, missing)
            .with_context(|| format!("cannot render an image with software OpenGL ({error})"))?;
        ensure!(is_installed, "cannot render an image with software OpenGL: {error}");
        self.render_one_image()
            .context("cannot render an image, though software OpenGL was just installed")
    }

    /// The error is the last line of Python's: the lines before it are of other packages.
    fn render_one_image(&self) -> Result<()> {
        let mut python = self.command();
        let output = python.args(["-c", RENDER_ONE_IMAGE]).output();
        let output = output.with_context(|| format!("cannot start {}", self.python.display()))?;
        let said = last_lines(&output);
        ensure!(output.status.success(), "{}", said.lines().next_back().unwrap_or_default());
        Ok(())
    }

    /// An error that names the packages that differ from a list.
    fn compare_packages(&self, lock: &Path) -> Result<()> {
        ensure!(self.python.exists(), "there is no Python environment {}", self.python.display());
        let output = self.command().args(["-c", COMPARE_PACKAGES]).arg(lock).output();
        let output = output.with_context(|| format!("cannot start {}", self.python.display()))?;
        ensure!(output.status.success(), "{}", last_lines(&output));
        let wrong = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        ensure!(wrong.is_empty(), "{}: packages differ: {wrong}", self.python.display());
        Ok(())
    }
}

/// Python with the servers' packages. Fast when they are installed already.
pub fn servers_environment(
    installation: &Installation,
    missing: Missing,
) -> Result<PythonEnvironment> {
    environment_with(installation, "", &[SERVERS_LOCK], missing)
}

/// A Python apart from the servers' own, with robosuite, Gymnasium's environments and gymnasium-robotics: robosuite's
/// packages and the servers' newest do not go together.
pub fn simulators_environment(
    installation: &Installation,
    missing: Missing,
) -> Result<PythonEnvironment> {
    environment_with(installation, "simulators", &[SIMULATORS_LOCK], missing)
}

/// Like [`servers_environment`], with the tools that only the tests need.
pub fn development_environment(installation: &Installation) -> Result<PythonEnvironment> {
    environment_with(installation, "", &[SERVERS_LOCK, DEVELOPMENT_LOCK], Missing::Install)
}

/// A Python of the user's, which has the packages already. Such an interpreter may need the user's library path.
pub fn named_environment(
    installation: &Installation,
    python: &Path,
    missing: Missing,
) -> PythonEnvironment {
    let mut environment = PythonEnvironment::new(python.to_owned(), installation, missing);
    let libraries = OsString::from("LD_LIBRARY_PATH");
    if let Some(path) = installation.host.variables.get(&libraries) {
        environment.variables.insert(libraries, path.clone());
    }
    environment
}

fn environment_with(
    installation: &Installation,
    name: &str,
    locks: &[&str],
    missing: Missing,
) -> Result<PythonEnvironment> {
    let files: Vec<PathBuf> =
        locks.iter().map(|lock| installation.package_root().join(lock)).collect();
    let digests: Vec<String> = files.iter().map(|file| digest_of(file)).collect::<Result<_>>()?;
    let folder = installation.environment_folder(name, digests.first().context("no packages")?);
    let environment = PythonEnvironment::new(folder.join("bin/python"), installation, missing);
    for (lock, digest) in files.iter().zip(&digests) {
        let setup = Setup { installation, environment: &environment, folder: &folder, lock };
        match missing {
            Missing::Install => setup.install_once(digest)?,
            Missing::Report => environment
                .compare_packages(lock)
                .map_err(|error| anyhow!("{error:#}; install with: {}", setup.line()))?,
        }
    }
    Ok(environment)
}

/// Installs one list of packages into one environment.
struct Setup<'a> {
    installation: &'a Installation,
    environment: &'a PythonEnvironment,
    folder: &'a Path,
    lock: &'a Path,
}

impl Setup<'_> {
    /// A stamp for each list of packages says what is installed: the tools of the tests come and go without the servers'
    /// packages.
    fn install_once(&self, digest: &str) -> Result<()> {
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
        // Another process may have done it while this one waited.
        if is_installed() {
            return Ok(());
        }
        let start = Instant::now();
        eprintln!("installing Python packages into {} (once)", self.folder.display());
        self.install()?;
        if !self.lock.ends_with(DEVELOPMENT_LOCK) {
            self.environment.ensure_rendering(Missing::Install)?;
        }
        std::fs::write(&stamp, digest)
            .with_context(|| format!("cannot write {}", stamp.display()))?;
        eprintln!("installed in {:.0} s", start.elapsed().as_secs_f64());
        Ok(())
    }

    /// With uv where it is found, which takes seconds; with venv and pip elsewhere, and where uv fails: the two are
    /// configured apart, so that pip may know a package index that uv does not.
    fn install(&self) -> Result<()> {
        if finds("uv") {
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
            None => Err(anyhow!("no Python {major}.{minor} or newer was found")),
        };
        let Err(error) = first else { return Ok(()) };
        // A half-made folder of the first attempt is completed by the second.
        let is_installed = install_missing(&PYTHON_PACKAGES, Missing::Install)
            .with_context(|| format!("cannot create a Python environment ({error:#})"))?;
        if !is_installed {
            return Err(error);
        }
        let python = self.find_python().with_context(|| {
            format!("this system's python3 is older than {major}.{minor}: put a newer one on PATH")
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
            "{} ended with {}\n{}",
            program.display(),
            output.status,
            last_lines(&output)
        );
        Ok(())
    }

    /// What a user can run instead of any command that starts servers.
    fn line(&self) -> String {
        if self.installation.is_temporary() {
            return "rever demo --episodes 1".to_owned();
        }
        let (folder, lock) = (self.folder.display(), self.lock.display());
        if finds("uv") {
            let python = self.environment.python.display();
            return format!(
                "uv venv --seed --allow-existing --python '{PYTHON_VERSIONS_OF_UV}' {folder} && \
                 uv pip install --python {python} --require-hashes -r {lock}"
            );
        }
        format!(
            "python3 -m venv {folder} && {folder}/bin/python -m pip install --require-hashes -r {lock}"
        )
    }
}

fn finds(program: &str) -> bool {
    Command::new(program).arg("--version").output().is_ok_and(|output| output.status.success())
}

fn digest_of(file: &Path) -> Result<String> {
    let bytes = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
    Ok(Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Held until the returned file is closed, so that two programs never install into one folder at
/// the same time.
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

/// The end of what a command printed.
pub(super) fn last_lines(output: &Output) -> String {
    let text = format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    let lines: Vec<&str> = text.lines().collect();
    lines[lines.len().saturating_sub(OUTPUT_LINES_MAX)..].join("\n")
}
