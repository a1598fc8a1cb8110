//! Tells the program the commit that it is built from, and when.

use std::process::Command;
use std::time::{Duration, SystemTime};

/// Seconds since 1970, set where builds must be reproducible.
const SOURCE_DATE: &str = "SOURCE_DATE_EPOCH";

fn main() {
    for place in ["../../.git/HEAD", "../../.git/index", "..", "../../protocol/src"] {
        println!("cargo::rerun-if-changed={place}");
    }
    println!("cargo::rerun-if-env-changed={SOURCE_DATE}");
    println!("cargo::rustc-env=REVER_COMMIT={}", commit());
    println!("cargo::rustc-env=REVER_BUILD_DATE={}", date());
}

/// The commit, with `-dirty` where files differ from it; empty outside of a checkout.
fn commit() -> String {
    let arguments = ["describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"];
    let output = Command::new("git").args(arguments).output();
    let text = output.ok().filter(|output| output.status.success()).map(|output| output.stdout);
    let text = text.and_then(|bytes| String::from_utf8(bytes).ok()).unwrap_or_default();
    text.trim().to_owned()
}

/// Of the build, RFC 3339.
fn date() -> String {
    let asked = std::env::var(SOURCE_DATE).ok().and_then(|secs| secs.parse().ok());
    let time = asked.map(|secs| SystemTime::UNIX_EPOCH + Duration::from_secs(secs));
    humantime::format_rfc3339_seconds(time.unwrap_or_else(SystemTime::now)).to_string()
}
