//! Shared by all tests of processes: the built program, Python, and waits with a limit.

use std::fs::Metadata;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use runtime::servers::{
    Host, Installation, LocalSource, Missing, PythonEnvironment, ServerProgram, Simulator,
    development_environment, install_missing, peers_environment,
};

/// How often a condition is checked while a test waits for it.
const LOOK_MS: u64 = 20;

/// The root of this checkout.
pub fn repository() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the crate lies in the repository")
}

/// The program, built once with the profile of this test. Cargo builds it only for its own crate
/// and passes its path to no other.
pub fn rever() -> Command {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    Command::new(PROGRAM.get_or_init(|| {
        let test = std::env::current_exe().expect("this test runs from a file");
        let folder = test.ancestors().nth(2).expect("tests lie in target/<profile>/deps");
        let mut build = cargo();
        // Building the whole workspace resolves the same features as for this test, so that no
        // dependency is built a second time.
        build.args(["build", "--quiet", "--workspace", "--bin", "rever"]);
        if folder.ends_with("release") {
            build.arg("--release");
        }
        succeed(&mut build);
        folder.join("rever")
    }))
}

/// The cargo that runs this test, in the repository.
pub fn cargo() -> Command {
    let mut cargo = Command::new(env!("CARGO"));
    cargo.current_dir(repository());
    cargo
}

/// Python with the servers' packages and the tools of the tests, and software OpenGL.
pub fn python() -> &'static PythonEnvironment {
    static ENVIRONMENT: OnceLock<PythonEnvironment> = OnceLock::new();
    ENVIRONMENT.get_or_init(|| development_environment(&installation()).expect("Python is set up"))
}

/// Python with the environments, vla-eval and openpi-client: the peers of the policy protocols.
pub fn peers() -> &'static PythonEnvironment {
    static ENVIRONMENT: OnceLock<PythonEnvironment> = OnceLock::new();
    ENVIRONMENT.get_or_init(|| peers_environment(&installation()).expect("Python is set up"))
}

/// This checkout, with the variables of this process.
pub fn installation() -> Installation {
    let variables = std::env::vars_os().collect();
    Installation::checkout(repository(), &Host { variables, ..Host::default() })
}

/// All files and folders below a folder, with their metadata.
pub fn entries_below(folder: &Path) -> impl Iterator<Item = (PathBuf, Metadata)> {
    let mut folders = vec![folder.to_owned()];
    let mut found = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in folder.read_dir().expect("a folder") {
            let entry = entry.expect("a readable folder");
            let data = entry.metadata().expect("a file");
            if data.is_dir() {
                folders.push(entry.path());
            }
            found.push((entry.path(), data));
        }
    }
    found.into_iter()
}

/// Installs Debian's Chromium if this machine has no browser and this is root; otherwise the test says
/// what to install.
pub fn ensure_browser() {
    let path = std::env::var_os("PATH").expect("there is a PATH");
    let is_there =
        |name: &str| std::env::split_paths(&path).any(|folder| folder.join(name).is_file());
    if !["chromium", "chromium-browser", "google-chrome"].into_iter().any(is_there) {
        let variables = std::env::vars_os().collect();
        install_missing(&["chromium"], &variables, Missing::Install).expect("a browser");
    }
}

/// A simulator; it is installed or built if necessary.
pub fn simulator(simulator: Simulator) -> ServerProgram {
    let python = (simulator != Simulator::Robosuite).then(|| python().python.clone());
    let local = LocalSource { count: 1, simulator, python, installation: installation() };
    local.program(Missing::Install).expect("the simulator can be started")
}

/// Runs the command to its end, checks that it succeeds and returns its standard output.
pub fn succeed(command: &mut Command) -> String {
    let output = run(command);
    assert!(output.status.success(), "{command:?} ended with {}\n{}", output.status, text(&output));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Runs the command to its end.
pub fn run(command: &mut Command) -> Output {
    command.output().unwrap_or_else(|error| panic!("cannot start {command:?}: {error}"))
}

/// The complete output of a command.
pub fn text(output: &Output) -> String {
    let (stdout, stderr) = (&output.stdout, &output.stderr);
    format!("{}{}", String::from_utf8_lossy(stdout), String::from_utf8_lossy(stderr))
}

/// Waits until the condition returns a value; fails after the limit.
pub fn wait_for<T>(what: &str, limit: Duration, mut condition: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + limit;
    loop {
        if let Some(value) = condition() {
            return value;
        }
        assert!(Instant::now() < deadline, "waited {} s for {what}", limit.as_secs());
        std::thread::park_timeout(Duration::from_millis(LOOK_MS));
    }
}

/// A program that prints `ready NAME` once it can be used, NAME being its id or address. Killed when
/// dropped.
pub struct ReadyProgram {
    child: Child,
    /// What it calls itself.
    pub name: String,
}

impl ReadyProgram {
    /// Starts it and waits until it is ready.
    pub fn start(mut command: Command) -> ReadyProgram {
        command.stdin(Stdio::null()).stdout(Stdio::piped());
        let mut child = command.spawn().expect("the program starts");
        let stdout = child.stdout.take().expect("its standard output is piped");
        let mut line = String::new();
        BufReader::new(stdout).read_line(&mut line).expect("its standard output is text");
        let name = line.strip_prefix("ready ").and_then(|rest| rest.split_whitespace().next());
        let name = name.unwrap_or_else(|| panic!("expected \"ready NAME\", got {line:?}"));
        ReadyProgram { name: name.to_owned(), child }
    }

    /// Kills it without any cleanup, like a crash.
    pub fn kill(&mut self) {
        self.child.kill().expect("the program runs");
        self.child.wait().expect("a killed program ends");
    }
}

impl Drop for ReadyProgram {
    fn drop(&mut self) {
        // It may have ended already, which is fine.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
