//! Sets up what a local server runs on: Python with pinned packages, and software OpenGL.
//!
//! Everything stays inside the repository's `.venv`. Only missing system packages are installed
//! outside of it, and only as root on a machine with apt; anybody else is told the one line to run.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use sha2::{Digest, Sha256};

/// Where everything lies.
const FOLDER: &str = ".venv";
/// The oldest Python that the locked packages support.
const PYTHON_VERSION_MIN: (u32, u32) = (3, 10);
/// Tried in this order; the first that is new enough is taken.
const PYTHON_NAMES: [&str; 7] =
    ["python3", "python3.14", "python3.13", "python3.12", "python3.11", "python3.10", "python"];
const RUNTIME_LOCK: &str = "env-server/requirements.lock";
const SIMULATORS_LOCK: &str = "env-server/requirements-simulators.lock";
const DEVELOPMENT_LOCK: &str = "env-server/requirements-development.lock";
/// The same names on Debian 12 and 13 and on Ubuntu 22.04 and 24.04. `libopengl0` holds the entry
/// points that MuJoCo loads, `libegl1` the off-screen context, `libgl1-mesa-dri` the software
/// renderer.
pub const GL_PACKAGES: [&str; 3] = ["libegl1", "libopengl0", "libgl1-mesa-dri"];
/// How much of a failed command's output an error repeats.
const OUTPUT_LINES_MAX: usize = 15;
/// Renders what a server renders; a frame of one colour is not a rendered frame.
const RENDER_ONE_FRAME: &str = "
from rever_env import tasks
from rever_env.world import World
world = World(next(iter(tasks.load().values())))
image = world.reset(layout=0, seed=0).image
world.close()
assert image.max() > image.min(), 'the rendered frame has one colour only'
";

/// A Python that can run `-m rever_env`.
#[derive(Debug, Clone)]
pub struct PythonEnvironment {
    /// The interpreter, with the locked packages installed.
    pub python: PathBuf,
    /// The folder that holds the package `rever_env`.
    pub package_root: PathBuf,
}

impl PythonEnvironment {
    /// A command for this Python, with the variables that `rever_env` needs.
    pub fn command(&self) -> Command {
        let mut command = Command::new(&self.python);
        command
            .env("PYTHONPATH", &self.package_root)
            // A pipe would otherwise hold lines back until a block is full, and with them the line
            // that says "ready".
            .env("PYTHONUNBUFFERED", "1")
            .env("MUJOCO_GL", "egl")
            // Frames must not depend on the graphics card that this machine may have.
            .env("LIBGL_ALWAYS_SOFTWARE", "1");
        command
    }
}

/// The checkout that this program was built from.
pub fn repository() -> Result<PathBuf> {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR"))
        .ancestors()
        .nth(2)
        .context("the crate has no parent folder")?;
    ensure!(
        repository.is_dir(),
        "rever was built from {}, which is no longer there: build it again",
        repository.display()
    );
    Ok(repository.to_path_buf())
}

/// Makes sure that this machine has what the servers need: packages in the repository's `.venv`,
/// and software OpenGL. Fast when that was done before.
pub fn python_environment(repository: &Path) -> Result<PythonEnvironment> {
    environment_with(repository, FOLDER, &[RUNTIME_LOCK])
}

/// A Python apart from the servers' own, with robosuite, Gymnasium's environments and gymnasium-robotics: robosuite's
/// packages and the servers' newest do not go together.
pub fn simulators_environment(repository: &Path) -> Result<PythonEnvironment> {
    environment_with(repository, ".venv/simulators", &[SIMULATORS_LOCK])
}

/// Like [`python_environment`], with the tools that only the tests need.
pub fn development_environment(repository: &Path) -> Result<PythonEnvironment> {
    environment_with(repository, FOLDER, &[RUNTIME_LOCK, DEVELOPMENT_LOCK])
}

/// Makes sure that a frame can be rendered without a screen or a graphics card.
pub fn software_gl(environment: &PythonEnvironment) -> Result<()> {
    let Err(error) = render_one_frame(environment) else { return Ok(()) };
    install_system_packages(&GL_PACKAGES)
        .with_context(|| format!("no frame could be rendered with software OpenGL ({error})"))?;
    render_one_frame(environment)
        .context("no frame could be rendered, though software OpenGL was just installed")
}

fn environment_with(repository: &Path, folder: &str, locks: &[&str]) -> Result<PythonEnvironment> {
    let folder = repository.join(folder);
    let environment = PythonEnvironment {
        python: folder.join("bin/python"),
        package_root: repository.join("env-server"),
    };
    for lock in locks {
        let locked = repository.join(lock);
        let wanted = digest_of(&locked)?;
        // One stamp for each list of packages: the tools of the tests come and go without the
        // servers' packages.
        let name = locked.file_stem().context("a list of packages has a name")?;
        let stamp = folder.join(name).with_extension("installed");
        if is_stamped(&environment, &stamp, &wanted) {
            continue;
        }
        let _guard = lock_folder(&folder)?;
        // Another process may have done it while this one waited.
        if !is_stamped(&environment, &stamp, &wanted) {
            install(&environment, &folder, &locked)?;
            if *lock != DEVELOPMENT_LOCK {
                software_gl(&environment)?;
            }
            std::fs::write(&stamp, &wanted)
                .with_context(|| format!("cannot write {}", stamp.display()))?;
        }
    }
    Ok(environment)
}

fn digest_of(file: &Path) -> Result<String> {
    let bytes = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
    Ok(Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect())
}

fn is_stamped(environment: &PythonEnvironment, stamp: &Path, wanted: &str) -> bool {
    environment.python.exists() && std::fs::read_to_string(stamp).is_ok_and(|found| found == wanted)
}

/// Held until the returned file is closed, so that two programs never install into one folder at
/// the same time.
fn lock_folder(folder: &Path) -> Result<File> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot create {}", folder.display()))?;
    let path = folder.join("setup.lock");
    let file = File::create(&path).with_context(|| format!("cannot create {}", path.display()))?;
    if file.try_lock().is_err() {
        eprintln!("another process sets up {}: waiting for it", folder.display());
        file.lock().with_context(|| format!("cannot lock {}", path.display()))?;
    }
    Ok(file)
}

fn install(environment: &PythonEnvironment, folder: &Path, locked: &Path) -> Result<()> {
    let start = Instant::now();
    if !environment.python.exists() {
        eprintln!("creating the Python environment {}", folder.display());
        create_venv(folder)?;
    }
    eprintln!("installing the packages of {} (once, about a minute)", locked.display());
    let mut pip = Command::new(&environment.python);
    pip.args([
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-input",
        "--disable-pip-version-check",
        "--require-hashes",
        "-r",
    ]);
    run(pip.arg(locked))?;
    eprintln!("installed in {:.0} s", start.elapsed().as_secs_f64());
    Ok(())
}

fn create_venv(folder: &Path) -> Result<()> {
    let attempt = |python: &str| run(Command::new(python).args(["-m", "venv"]).arg(folder));
    if let Some(python) = find_python()
        && attempt(python).is_ok()
    {
        return Ok(());
    }
    // Debian's python3 comes without venv. A half-made folder of the first attempt is completed by
    // the second.
    let (major, minor) = PYTHON_VERSION_MIN;
    install_system_packages(&["python3", "python3-venv"]).with_context(|| {
        format!("no Python {major}.{minor} or newer with its module venv was found")
    })?;
    let python = find_python().with_context(|| {
        format!(
            "this system's python3 is older than {major}.{minor}: put a newer one first on the path"
        )
    })?;
    attempt(python)
}

fn find_python() -> Option<&'static str> {
    PYTHON_NAMES.into_iter().find(|name| {
        let (major, minor) = PYTHON_VERSION_MIN;
        let check = format!("import sys; sys.exit(sys.version_info[:2] < ({major}, {minor}))");
        Command::new(name).args(["-c", &check]).output().is_ok_and(|output| output.status.success())
    })
}

/// The error is the last line of Python's: the lines before it lead through other people's packages.
fn render_one_frame(environment: &PythonEnvironment) -> Result<()> {
    let mut python = environment.command();
    let output = python.args(["-c", RENDER_ONE_FRAME]).output();
    let output =
        output.with_context(|| format!("cannot start {}", environment.python.display()))?;
    let said = last_lines(&output, 1);
    ensure!(output.status.success(), "{said}");
    Ok(())
}

/// Installs with apt as root; otherwise the error is the line to run.
fn install_system_packages(packages: &[&str]) -> Result<()> {
    let names = packages.join(" ");
    let Some(output) = run_if_found(Command::new("apt-get").arg("--version"))? else {
        bail!("install what your system calls {names}, then start again");
    };
    ensure!(
        output.status.success(),
        "apt-get does not work: {}",
        last_lines(&output, OUTPUT_LINES_MAX)
    );
    let user = run_if_found(Command::new("id").arg("-u"))?;
    if user.is_none_or(|output| output.stdout.trim_ascii() != b"0") {
        bail!("run this line, then start again: sudo apt-get install -y {names}");
    }
    eprintln!("installing the system packages {names}");
    run(Command::new("apt-get").args(["update", "-qq"]))?;
    let mut install = Command::new("apt-get");
    install.args(["install", "-y", "-qq", "--no-install-recommends"]).args(packages);
    run(install.env("DEBIAN_FRONTEND", "noninteractive"))
}

fn run(command: &mut Command) -> Result<()> {
    let output = command.output().with_context(|| format!("cannot start {command:?}"))?;
    ensure!(
        output.status.success(),
        "{command:?} ended with {}\n{}",
        output.status,
        last_lines(&output, OUTPUT_LINES_MAX)
    );
    Ok(())
}

/// `None` when there is no such program.
fn run_if_found(command: &mut Command) -> Result<Option<Output>> {
    match command.output() {
        Ok(output) => Ok(Some(output)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error).with_context(|| format!("cannot start {command:?}")),
    }
}

fn last_lines(output: &Output, count: usize) -> String {
    let text = format!(
        "{}{}",
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    let lines: Vec<&str> = text.lines().collect();
    lines[lines.len().saturating_sub(count)..].join("\n")
}
