//! Tells the program the commit that it is built from.

use std::process::Command;

fn main() {
    for place in ["../../.git/HEAD", "../../.git/index", "..", "../../protocol/src"] {
        println!("cargo::rerun-if-changed={place}");
    }
    println!("cargo::rustc-env=REVER_COMMIT={}", commit());
}

/// The commit, with `-dirty` where files differ from it; `unknown` outside of a checkout.
fn commit() -> String {
    let arguments = ["describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"];
    let output = Command::new("git").args(arguments).output();
    let text = output.ok().filter(|output| output.status.success()).map(|output| output.stdout);
    let text = text.and_then(|bytes| String::from_utf8(bytes).ok()).unwrap_or_default();
    let text = text.trim();
    if text.is_empty() { "unknown".to_owned() } else { text.to_owned() }
}
