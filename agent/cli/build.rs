//! Sets the program's commit and build date, packs the files embedded in it, and copies the Python package for the wheel.

#![allow(clippy::disallowed_methods, reason = "cargo tells a build script everything in variables")]

use std::error::Error;
use std::ffi::OsString;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, SystemTime};

use flate2::{Compression, write::GzEncoder};
use sha2::{Digest, Sha256};
use tar::{Builder, Header};

/// Seconds since 1970, set where builds must be reproducible.
const SOURCE_DATE: &str = "SOURCE_DATE_EPOCH";
const ROOT: &str = "../..";
/// The Python package, and the assets that an installed one contains.
const PACKAGE: &str = "env-server/rever_env";
const ASSETS: &str = "env-server/assets";
/// Embedded files and folders, with their paths in a checkout: environment servers and the included policy.
const CARRIED: [&str; 8] = [
    "env-server/assets",
    "env-server/requirements.lock",
    "env-server/requirements-simulators.lock",
    "env-server/rever_env",
    "agent/models/bridge-small/config.json",
    "agent/models/bridge-small/model.safetensors",
    "agent/models/bridge-small/tokenizer.json",
    "agent/models/bridge-small/verifier.safetensors",
];

fn main() -> Result<(), Box<dyn Error>> {
    for place in [".git/HEAD", ".git/index", "agent", "protocol/src"].iter().chain(&CARRIED) {
        println!("cargo::rerun-if-changed={ROOT}/{place}");
    }
    println!("cargo::rerun-if-env-changed={SOURCE_DATE}");
    println!("cargo::rustc-env=REVER_COMMIT={}", commit());
    println!("cargo::rustc-env=REVER_BUILD_DATE={}", date());
    println!("cargo::rustc-env=REVER_FILES_DIGEST={}", pack()?);
    lay_out_package()
}

/// The commit, with `-dirty` where files differ from it; empty outside of a checkout.
fn commit() -> String {
    let arguments = ["describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"];
    let output = Command::new("git").args(arguments).output();
    let text = output.ok().filter(|output| output.status.success()).map(|output| output.stdout);
    let text = text.and_then(|bytes| String::from_utf8(bytes).ok()).unwrap_or_default();
    text.trim().to_owned()
}

/// The build date, RFC 3339.
fn date() -> String {
    let asked = std::env::var(SOURCE_DATE).ok().and_then(|secs| secs.parse().ok());
    let time = asked.map(|secs| SystemTime::UNIX_EPOCH + Duration::from_secs(secs));
    humantime::format_rfc3339_seconds(time.unwrap_or_else(SystemTime::now)).to_string()
}

/// Writes the archive and returns its digest; the same files give the same bytes.
fn pack() -> Result<String, Box<dyn Error>> {
    let folder = PathBuf::from(std::env::var("OUT_DIR")?);
    let path = folder.join("files.tar.gz");
    let mut archive = Builder::new(GzEncoder::new(File::create(&path)?, Compression::best()));
    for place in CARRIED {
        append(&mut archive, Path::new(place))?;
    }
    archive.into_inner()?.finish()?;
    let digest = Sha256::digest(std::fs::read(&path)?);
    Ok(digest.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Copies the package to where pyproject.toml takes it from.
fn lay_out_package() -> Result<(), Box<dyn Error>> {
    let package = PathBuf::from(std::env::var("OUT_DIR")?).join("rever_env");
    // Deleted files must not stay in the wheel.
    if package.exists() {
        std::fs::remove_dir_all(&package)?;
    }
    copy(&Path::new(ROOT).join(PACKAGE), &package)?;
    copy(&Path::new(ROOT).join(ASSETS), &package.join("assets"))
}

fn copy(from: &Path, to: &Path) -> Result<(), Box<dyn Error>> {
    std::fs::create_dir_all(to)?;
    for name in names_in(from)? {
        let (from, to) = (from.join(&name), to.join(&name));
        if from.is_dir() {
            copy(&from, &to)?;
        } else {
            std::fs::copy(&from, &to)?;
        }
    }
    Ok(())
}

/// Sorted, without compiled Python files.
fn names_in(folder: &Path) -> Result<Vec<OsString>, Box<dyn Error>> {
    let entries: Result<Vec<_>, _> = folder.read_dir()?.collect();
    let mut names: Vec<_> = entries?.into_iter().map(|entry| entry.file_name()).collect();
    names.retain(|name| name != "__pycache__");
    names.sort();
    Ok(names)
}

fn append(archive: &mut Builder<GzEncoder<File>>, place: &Path) -> Result<(), Box<dyn Error>> {
    let path = Path::new(ROOT).join(place);
    if path.is_dir() {
        for name in names_in(&path)? {
            append(archive, &place.join(name))?;
        }
        return Ok(());
    }
    let bytes = std::fs::read(&path)?;
    let mut header = Header::new_gnu();
    header.set_size(bytes.len() as u64);
    header.set_mode(0o644);
    Ok(archive.append_data(&mut header, place, bytes.as_slice())?)
}
