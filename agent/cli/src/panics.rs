//! Reports a panic as an internal error, with its source location but without paths of the build machine.

use std::backtrace::{Backtrace, BacktraceStatus};
use std::io::{Write, stderr};
use std::panic::PanicHookInfo;

/// Installs a panic hook. The standard hook prints source paths of the build machine.
pub fn report_panics() {
    std::panic::set_hook(Box::new(report));
}

fn report(panic: &PanicHookInfo<'_>) {
    let message = panic.payload_as_str().unwrap_or("no message");
    // In `rever ... | head`, `head` closes the pipe early. That ends the program, but it is not a bug.
    if message.starts_with("failed printing to std") && message.contains("Broken pipe") {
        return;
    }
    let place = panic.location().map(|at| format!(" ({}:{})", name_of(at.file()), at.line()));
    // If standard error is closed, there is nowhere left to report to.
    let _ = writeln!(stderr(), "internal error: {message}{}", place.unwrap_or_default());
    let backtrace = Backtrace::capture();
    if backtrace.status() == BacktraceStatus::Captured {
        let _ = writeln!(stderr(), "{backtrace}");
    }
}

/// The path of a source file, starting at its crate.
fn name_of(file: &str) -> &str {
    // REGISTRY/src/INDEX/CRATE-VERSION/src/...
    match file.split_once("/registry/src/").and_then(|(_, rest)| rest.split_once('/')) {
        Some((_, name)) => name,
        None if file.starts_with('/') => file.rsplit('/').next().unwrap_or(file),
        None => file,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_folder_of_the_machine_that_built_the_program_is_named() {
        let check = |file, expected| assert_eq!(name_of(file), expected);
        check(
            "/home/a b/.cargo/registry/src/index.crates.io-1/zenoh-1.10/src/x.rs",
            "zenoh-1.10/src/x.rs",
        );
        check("/home/a b/rever/agent/cli/src/main.rs", "main.rs");
        check("agent/cli/src/main.rs", "agent/cli/src/main.rs");
    }
}
