//! The program away from its checkout, in hostile surroundings, and what `doctor` leaves untouched.

use std::collections::BTreeMap;
use std::fs::Metadata;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use runtime::servers::{Missing, simulators_environment};
use tempfile::TempDir;

use crate::harness::{entries_below, installation, python, repository, rever, run, text};

/// Each alone stops a server, or changes what it imports or draws, if it gets there.
const HOSTILE: [(&str, &str); 18] = [
    ("CUDA_VISIBLE_DEVICES", "GPU-8932f937-d72c-4106-c12f-20bd9faed9f6"),
    ("DISPLAY", ":99"),
    ("EGL_PLATFORM", "x11"),
    ("GALLIUM_DRIVER", "nothing"),
    ("LC_ALL", "tlh_QO"),
    ("LD_LIBRARY_PATH", "/nowhere"),
    ("LIBGL_ALWAYS_SOFTWARE", "0"),
    ("LIBGL_DRIVERS_PATH", "/nowhere"),
    ("MESA_LOADER_DRIVER_OVERRIDE", "nothing"),
    ("MUJOCO_EGL_DEVICE_ID", "7"),
    ("MUJOCO_GL", "glfw"),
    ("PYOPENGL_PLATFORM", "osmesa"),
    ("PYTHONHOME", "/nowhere"),
    ("PYTHONOPTIMIZE", "2"),
    ("PYTHONPATH", "/nowhere"),
    ("PYTHONSTARTUP", "/nowhere"),
    ("VIRTUAL_ENV", "/nowhere"),
    ("__EGL_VENDOR_LIBRARY_FILENAMES", "/nowhere"),
];

/// A copy of the program in a folder that has nothing else of the project.
struct Copied {
    folder: TempDir,
}

impl Copied {
    fn new() -> Copied {
        let folder = tempfile::tempdir().expect("a folder");
        for name in ["bin", "home", "work"] {
            std::fs::create_dir(folder.path().join(name)).expect("a folder can be made");
        }
        let copied = Copied { folder };
        std::fs::copy(rever().get_program(), copied.path("bin/rever")).expect("it can be copied");
        copied
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// The program with a home and a current folder of its own.
    fn command(&self) -> Command {
        let mut command = Command::new(self.path("bin/rever"));
        let path = std::env::var_os("PATH").expect("there is a PATH");
        command.env_clear().env("PATH", path).env("HOME", self.path("home"));
        command.current_dir(self.path("work"));
        command
    }

    /// All files by their contents' lengths.
    fn files(&self) -> BTreeMap<PathBuf, u64> {
        let length = |data: Metadata| if data.is_dir() { 0 } else { data.len() };
        entries_below(self.folder.path()).map(|(path, data)| (path, length(data))).collect()
    }

    /// What pip leaves of a wheel that requires this package: a record, and the Python beside the program.
    fn install_wheel(&self, requirement: &str) -> PathBuf {
        let packages = self.path("lib/python3.99/site-packages");
        let record = packages.join("rever-0.0.0.dist-info");
        std::fs::create_dir_all(&record).expect("folders can be made");
        let metadata = format!(
            "Metadata-Version: 2.4\nName: rever\nVersion: 0.0.0\nRequires-Dist: {requirement}\n"
        );
        std::fs::write(record.join("METADATA"), metadata).expect("a file can be written");
        let beside = self.path("bin/python3");
        let (packages, python) = (packages.display(), python().python.display());
        let script = format!("PYTHONPATH=\"$PYTHONPATH:{packages}\" exec {python} \"$@\"");
        write_program(&beside, &script);
        beside
    }

    /// A program that says that it was asked, and does nothing; all of them come first on the returned PATH.
    fn decoys(&self, names: &[&str]) -> std::ffi::OsString {
        let folder = self.path("decoys");
        std::fs::create_dir(&folder).expect("a folder can be made");
        for name in names {
            let script = format!("echo {name} \"$@\" >> {}", self.path("asked").display());
            write_program(&folder.join(name), &script);
        }
        let path = std::env::var_os("PATH").expect("there is a PATH");
        let folders = [folder].into_iter().chain(std::env::split_paths(&path));
        std::env::join_paths(folders).expect("a PATH")
    }
}

fn write_program(file: &Path, script: &str) {
    std::fs::write(file, format!("#!/bin/sh\n{script}\n")).expect("a script can be written");
    let mode = std::fs::Permissions::from_mode(0o755);
    std::fs::set_permissions(file, mode).expect("it can be run");
}

fn assert_success(output: &Output) {
    assert!(output.status.success(), "{}: {}", output.status, text(output));
}

#[test]
fn a_copied_program_runs_episodes_without_its_checkout() {
    let copied = Copied::new();
    let python = python().python.clone();
    let mut evaluate = copied.command();
    evaluate.args(["evaluate", "--strategies=verifier", "--candidates=2", "--episodes=1"]);
    evaluate.args(["--tasks=widowx_spoon_on_towel", "--servers=1", "--out=run", "--python"]);
    let output = run(evaluate.arg(&python));
    assert_success(&output);
    let said = text(&output);
    assert!(!said.contains(repository().to_str().expect("a path in UTF-8")), "{said}");
    let data = copied.path("home/.local/share/rever");
    let unpacked: Vec<_> = data.read_dir().expect("the data folder").flatten().collect();
    assert_eq!(unpacked.len(), 1, "{unpacked:?}");
    assert!(unpacked[0].path().join("env-server/assets/tasks.toml").is_file());
}

#[test]
fn doctor_changes_nothing_and_names_what_is_missing() {
    let copied = Copied::new();
    let path = copied.decoys(&["apt-get", "pip", "sudo", "uv"]);
    let before = copied.files();
    let output = run(copied.command().env("PATH", path).arg("doctor"));
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("FAULT python"), "{said}");
    assert!(said.contains("there is no Python environment"), "{said}");
    assert!(said.contains("install with: rever demo --episodes 1"), "{said}");
    assert!(said.contains("ok    policy"), "{said}");
    let asked = std::fs::read_to_string(copied.path("asked")).unwrap_or_default();
    assert!(!asked.contains("install"), "{asked}");
    let mut after = copied.files();
    after.remove(&copied.path("asked"));
    assert_eq!(after, before);
}

#[test]
fn doctor_finds_a_machine_ready_and_leaves_it_as_it_is() {
    let copied = Copied::new();
    let before = copied.files();
    let python = python().python.clone();
    let output = run(copied.command().args(["doctor", "--python"]).arg(python));
    assert_success(&output);
    assert_eq!(copied.files(), before);
}

#[test]
fn the_python_that_a_wheel_was_installed_into_runs_the_servers() {
    let copied = Copied::new();
    let python = copied.install_wheel("mujoco==3.8.0");
    let before = copied.files();
    let output = run(copied.command().arg("doctor"));
    assert_success(&output);
    let said = text(&output);
    assert!(said.contains(&format!("({})", python.display())), "{said}");
    assert_eq!(copied.files(), before);
}

#[test]
fn a_python_with_other_packages_than_its_wheel_requires_is_named_and_not_used() {
    let copied = Copied::new();
    let python = copied.install_wheel("mujoco==0.1");
    let said = text(&run(copied.command().arg("doctor")));
    let reason = format!(
        "the Python that rever was installed into ({}) cannot run servers: packages differ: mujoco==0.1 (found 3.8.0)",
        python.display()
    );
    assert!(said.contains(&reason), "{said}");
    assert!(said.contains("there is no Python environment"), "{said}");
}

#[test]
fn a_named_python_that_cannot_run_servers_is_refused_with_a_hint() {
    let copied = Copied::new();
    let bare = copied.path("bare-python");
    write_program(&bare, &format!("exec {} -S \"$@\"", python().python.display()));
    for (named, expected) in [
        (bare, "lacks mujoco, numpy, gymnasium, zenoh, msgpack; omit --python"),
        ("/bin/false".into(), "expected a Python, got a program with exit status: 1"),
        (
            "/nowhere/python".into(),
            "cannot run it as a Python interpreter: No such file or directory",
        ),
    ] {
        let output = run(copied.command().args(["doctor", "--python"]).arg(&named));
        let said = text(&output);
        assert_eq!(output.status.code(), Some(1), "{said}");
        let fault = format!("FAULT python      --python {}: ", named.display());
        assert!(said.contains(&fault) && said.contains(expected), "{said}");
    }
    let mut evaluate = copied.command();
    evaluate.args(["evaluate", "--strategies=greedy", "--episodes=1", "--python"]);
    let said = text(&run(evaluate.arg(copied.path("bare-python"))));
    assert!(said.contains("-m pip install -r ") && said.contains("requirements.lock"), "{said}");
}

#[test]
fn servers_run_whatever_the_users_variables_say() {
    let copied = Copied::new();
    let simulators = simulators_environment(&installation(), Missing::Install).expect("packages");
    for (simulator, python) in [("python", python()), ("robosuite", &simulators)] {
        let mut doctor = copied.command();
        doctor.envs(HOSTILE).args(["doctor", "--simulator", simulator, "--python"]);
        let output = run(doctor.arg(&python.python));
        assert!(output.status.success(), "{simulator}: {}", text(&output));
    }
}

#[test]
fn the_native_simulator_says_where_it_is_built() {
    let copied = Copied::new();
    let python = python().python.clone();
    let mut evaluate = copied.command();
    evaluate.args(["evaluate", "--simulator=native", "--episodes=1", "--python"]).arg(python);
    let output = run(&mut evaluate);
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("build it in a checkout with"), "{said}");
}

#[test]
fn too_few_open_files_are_named() {
    let copied = Copied::new();
    let program = copied.command();
    let program = Path::new(program.get_program()).display();
    let line = format!("ulimit -n 24; exec {program} doctor --connect tcp/127.0.0.1:9");
    let mut shell = Command::new("sh");
    shell.args(["-c", &line]).current_dir(copied.path("work")).env("HOME", copied.path("home"));
    let output = run(&mut shell);
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("a limit of at least 64 open files, got 24, see `ulimit -n`"), "{said}");
}

#[test]
fn an_endpoint_that_cannot_be_used_is_wrong_usage() {
    for endpoint in ["tls/localhost:7447", "tcp/localhost", "localhost"] {
        let output = run(rever().args(["evaluate", "--connect", endpoint]));
        let said = text(&output);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.contains("expected HOST:PORT, such as"), "{said}");
    }
}

#[test]
fn too_little_memory_for_a_server_is_named() {
    let copied = Copied::new();
    let program = copied.command();
    let line = format!(
        "ulimit -v 450000; exec {} doctor --python {}",
        Path::new(program.get_program()).display(),
        python().python.display()
    );
    let mut shell = Command::new("sh");
    shell.args(["-c", &line]).current_dir(copied.path("work")).env("HOME", copied.path("home"));
    let said = text(&run(&mut shell));
    assert!(said.contains("ulimit -v"), "{said}");
}
