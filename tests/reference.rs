//! Parity with OpenVLA's packages: `reference.py` builds small checkpoints, rever must agree.

use std::io::Write;
use std::path::Path;
use std::process::Command;

use runtime::servers::{Missing, install_missing};

use crate::harness::{installation, repository, rever, succeed};

/// Debian's PyTorch: PyPI's takes 3 GB, because it brings CUDA.
const SYSTEM_PACKAGES: [&str; 4] =
    ["python3", "python3-venv", "python3-torch", "python3-torchvision"];
/// The interpreter that Debian's packages belong to.
const PYTHON: &str = "/usr/bin/python3";

#[test]
fn small_checkpoints_agree_with_the_packages_of_the_reference() {
    let variables = std::env::vars_os().collect();
    install_missing(&SYSTEM_PACKAGES, &variables, Missing::Install).expect("Debian's PyTorch");
    let training = repository().join("agent/training");
    let python = environment(&training.join("requirements-reference.lock"));
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("reference");
    let program = rever().get_program().to_owned();
    for (kind, options) in [
        ("openvla", &["--unnorm-key", "bridge_orig"][..]),
        ("ecot", &[]),
        ("v01", &["--reasoning", "off"]),
    ] {
        let checkpoint = folder.join(kind);
        let script = || {
            let mut command = Command::new(&python);
            command.arg(training.join("reference.py"));
            command
        };
        succeed(script().arg("build").arg(&checkpoint).args(["--kind", kind, "--size", "small"]));
        let mut compare = script();
        compare.arg("compare").arg(&checkpoint).arg("--rever").arg(&program);
        let said = succeed(compare.arg("--").args(options));
        let last = said.lines().next_back().unwrap_or_default();
        writeln!(std::io::stderr(), "{kind}: {last}").expect("standard error is open");
        assert!(said.contains("rever and the reference agree on 3 observations"), "{said}");
        assert!(!said.contains("\"action_difference\": null"), "every action is compared: {said}");
        // A comparison that cannot fail shows nothing: another prompt must differ.
        let mut other = script();
        other.arg("compare").arg(&checkpoint).arg("--rever").arg(&program).arg("--");
        let other = other.args(options).args(["--prompt", "Do: {instruction}"]).output();
        let other = other.expect("the comparison starts");
        assert_eq!(other.status.code(), Some(1), "another prompt is noticed");
        let said = String::from_utf8_lossy(&other.stdout);
        assert!(said.contains("rever and the reference DIFFER"), "{said}");
    }
}

/// A Python with Debian's PyTorch and the reference's other packages, installed once per list.
fn environment(lock: &Path) -> std::path::PathBuf {
    let folder = installation().root.join(".venv/reference");
    let (python, stamp) = (folder.join("bin/python"), folder.join("packages.installed"));
    let wanted = std::fs::read_to_string(lock).expect("the list of packages");
    if python.exists() && std::fs::read_to_string(&stamp).is_ok_and(|found| found == wanted) {
        return python;
    }
    let mut venv = Command::new(PYTHON);
    succeed(venv.args(["-m", "venv", "--clear", "--system-site-packages"]).arg(&folder));
    let mut install = Command::new(&python);
    install.args(["-m", "pip", "install", "--quiet", "--no-input", "--no-deps"]);
    succeed(install.args(["--require-hashes", "-r"]).arg(lock));
    std::fs::write(&stamp, wanted).expect("the environment's folder can be written");
    python
}
