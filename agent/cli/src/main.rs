//! The program `rever`: parses the command line, runs one subcommand, prints one error.

use std::process::ExitCode;

use agent::command::Program;
use clap::Parser;
use protocol::transport::{RUNTIME_POOL, RUNTIME_VARIABLE};

fn main() -> ExitCode {
    say_nothing_of_closed_pipes();
    keep_freed_memory();
    let_senders_finish();
    if std::env::var_os(RUNTIME_VARIABLE).is_none() {
        // SAFETY: no other thread runs yet that could read the environment.
        unsafe { std::env::set_var(RUNTIME_VARIABLE, RUNTIME_POOL) };
    }
    // Wrong usage ends inside `parse`, with status 2 and a message that says what was expected.
    let program = Program::parse();
    #[expect(clippy::disallowed_methods, reason = "this is main")]
    let filter = std::env::var("REVER_LOG").ok();
    agent::command::start_log(filter.as_deref());
    match program.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(1)
        }
    }
}

/// Whoever reads has seen enough, as in `rever ... | head`: that ends the program, and is no defect to be reported.
fn say_nothing_of_closed_pipes() {
    let report = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        let words = panic.payload_as_str().unwrap_or_default();
        if !(words.starts_with("failed printing to std") && words.contains("Broken pipe")) {
            report(panic);
        }
    }));
}

/// Linux stops whoever wakes another on the same processor, in the middle of a picture that it sends. Not among threads of
/// this policy, which is for programs that compute; threads and servers that are started from here inherit it.
fn let_senders_finish() {
    #[cfg(target_os = "linux")]
    // SAFETY: the parameters are plain numbers, all zero; a policy that is refused changes nothing.
    unsafe {
        libc::sched_setscheduler(0, libc::SCHED_BATCH, &std::mem::zeroed());
    }
}

/// glibc gives memory as large as a picture back to the system as soon as it is free, and takes it anew for the next one,
/// page by page. The limits are where its own adaptation ends, after something large was freed.
fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: no other thread runs yet; a limit that is refused changes nothing.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, 32 << 20);
        libc::mallopt(libc::M_TRIM_THRESHOLD, 64 << 20);
    }
}
