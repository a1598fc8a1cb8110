//! Python for local servers: the one that rever was installed into, or an environment of its own with pinned packages; and
//! software OpenGL.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use anyhow::{Context, Result, bail, ensure};
use sha2::{Digest, Sha256};

use super::installation::{Installation, Missing};
use super::packages::PackageList;
use super::program::Simulator;
use super::system_packages::{GL_PACKAGES, install_missing};
use super::{variables, wheel};

const SERVERS_LOCK: &str = "requirements.lock";
const SIMULATORS_LOCK: &str = "requirements-simulators.lock";
const DEVELOPMENT_LOCK: &str = "requirements-development.lock";
const PEERS_LOCK: &str = "requirements-peers.lock";
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
/// Modules of the packages that servers need.
const SERVERS_MODULES: [&str; 5] = ["mujoco", "numpy", "gymnasium", "zenoh", "msgpack"];
const ROBOSUITE_MODULE: &str = "robosuite";
/// Prints the version of this Python, then those of the named modules that it lacks.
const LACKING_MODULES: &str = "
import importlib.util, sys
print('Python %d.%d' % sys.version_info[:2])
print(*[name for name in sys.argv[1:] if importlib.util.find_spec(name) is None])
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

    /// A Python that the user set up. Such an interpreter may need the user's library path.
    pub(super) fn of_user(
        python: PathBuf,
        installation: &Installation,
        missing: Missing,
    ) -> PythonEnvironment {
        let mut environment = PythonEnvironment::new(python, installation, missing);
        let libraries = OsString::from("LD_LIBRARY_PATH");
        if let Some(path) = installation.host.variables.get(&libraries) {
            environment.variables.insert(libraries, path.clone());
        }
        environment
    }

    /// A command for this Python, with the variables that `rever_env` needs.
    pub fn command(&self) -> Command {
        let mut command = Command::new(&self.python);
        command.env_clear().envs(&self.variables);
        command
    }

    /// Makes sure that an image can be rendered without a screen or a graphics card. System packages are installed only
    /// when that fails and some are found to be missing.
    pub fn ensure_rendering(&self, installation: &Installation, missing: Missing) -> Result<()> {
        let Err(error) = self.render_one_image() else { return Ok(()) };
        let is_installed = install_missing(&GL_PACKAGES, &installation.host.variables, missing)
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
}

/// Python with the servers' packages. Fast when they are installed already.
pub fn servers_environment(
    installation: &Installation,
    missing: Missing,
) -> Result<PythonEnvironment> {
    if !installation.is_checkout()
        && let Some(environment) = wheel::environment(installation, missing)?
    {
        return Ok(environment);
    }
    environment_with(installation, "", &[server_lock(installation, SERVERS_LOCK)], missing)
}

/// A Python apart from the servers' own, with robosuite, Gymnasium's environments and gymnasium-robotics: robosuite's
/// packages and the servers' newest do not go together.
pub fn simulators_environment(
    installation: &Installation,
    missing: Missing,
) -> Result<PythonEnvironment> {
    let lock = server_lock(installation, SIMULATORS_LOCK);
    environment_with(installation, "simulators", &[lock], missing)
}

/// Like [`servers_environment`], with the tools that only the tests need.
pub fn development_environment(installation: &Installation) -> Result<PythonEnvironment> {
    let locks = [SERVERS_LOCK, DEVELOPMENT_LOCK].map(|lock| server_lock(installation, lock));
    environment_with(installation, "", &locks, Missing::Install)
}

/// A Python apart from the servers' own, with the environments, vla-eval and openpi-client: the programs that tests run
/// against rever. Only a checkout has the list of its packages.
pub fn peers_environment(installation: &Installation) -> Result<PythonEnvironment> {
    let lock = installation.root.join("tests").join(PEERS_LOCK);
    environment_with(installation, "peers", &[lock], Missing::Install)
}

fn server_lock(installation: &Installation, name: &str) -> PathBuf {
    installation.package_root().join(name)
}

/// A Python of the user's, which has the packages already; an error says which it lacks, and how to install them.
pub fn named_environment(
    installation: &Installation,
    python: &Path,
    simulator: Simulator,
    missing: Missing,
) -> Result<PythonEnvironment> {
    let environment = PythonEnvironment::of_user(python.to_owned(), installation, missing);
    let is_robosuite = simulator == Simulator::Robosuite;
    let modules = SERVERS_MODULES.iter().chain(is_robosuite.then_some(&ROBOSUITE_MODULE));
    let name = python.display();
    let output = environment.command().args(["-c", LACKING_MODULES]).args(modules).output();
    let output = output
        .with_context(|| format!("--python {name}: cannot run it as a Python interpreter"))?;
    let said = String::from_utf8_lossy(&output.stdout);
    let mut lines = said.lines();
    let version =
        lines.next().filter(|line| output.status.success() && line.starts_with("Python "));
    let Some(version) = version else {
        let said = last_lines(&output);
        let last = said.lines().next_back().map(|line| format!(": {line}")).unwrap_or_default();
        bail!("--python {name}: expected a Python, got a program with {}{last}", output.status);
    };
    let lacking = lines.next().unwrap_or_default().replace(' ', ", ");
    let lock = installation.package_root().join(match simulator {
        Simulator::Robosuite => SIMULATORS_LOCK,
        Simulator::Python | Simulator::Native => SERVERS_LOCK,
    });
    // Files that were unpacked for this command alone are gone when it ends.
    let install = match installation.is_temporary() {
        true => String::new(),
        false => {
            format!("install its packages with `{name} -m pip install -r {}`, or ", lock.display())
        }
    };
    ensure!(
        lacking.is_empty(),
        "--python {name}: {version} lacks {lacking}; {install}omit --python and rever sets up a Python \
         environment of its own"
    );
    Ok(environment)
}

fn environment_with(
    installation: &Installation,
    name: &str,
    locks: &[PathBuf],
    missing: Missing,
) -> Result<PythonEnvironment> {
    let digests: Vec<String> = locks.iter().map(|lock| digest_of(lock)).collect::<Result<_>>()?;
    let folder = installation.environment_folder(name, digests.first().context("no packages")?);
    let environment = PythonEnvironment::new(folder.join("bin/python"), installation, missing);
    for (lock, digest) in locks.iter().zip(&digests) {
        let list = PackageList { installation, environment: &environment, folder: &folder, lock };
        match missing {
            Missing::Report => list.compare()?,
            Missing::Install => {
                let is_for_tests = lock.ends_with(DEVELOPMENT_LOCK);
                list.install_once(digest, || match is_for_tests {
                    true => Ok(()),
                    false => environment.ensure_rendering(installation, Missing::Install),
                })?;
            }
        }
    }
    Ok(environment)
}

fn digest_of(file: &Path) -> Result<String> {
    let bytes = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
    Ok(Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect())
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
