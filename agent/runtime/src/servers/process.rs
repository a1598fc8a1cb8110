//! One server process: its pipes are read, its last words kept, and it dies when this process does.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read, Result as IoResult};
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context, Result};

/// How much of a server's last words an error repeats.
const STDERR_LINES_MAX: usize = 20;

pub(super) struct ServerProcess {
    child: Child,
    stderr: Arc<Mutex<VecDeque<String>>>,
}

impl ServerProcess {
    /// `on_line` receives every line of the standard output; then `on_closed` is called, once.
    /// The process is killed when the calling thread ends.
    pub(super) fn spawn(
        command: &mut Command,
        on_line: impl Fn(String) + Send + 'static,
        on_closed: impl FnOnce() + Send + 'static,
    ) -> Result<ServerProcess> {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        // Ctrl-C in a terminal reaches the whole process group. The agent finishes its episodes on
        // it, and needs the servers for that.
        command.process_group(0);
        die_with_this_thread(command);
        let mut child = command.spawn().with_context(|| format!("cannot start {command:?}"))?;
        let stdout = child.stdout.take().context("the standard output is piped")?;
        let stderr = child.stderr.take().context("the standard error is piped")?;
        let last_lines = Arc::new(Mutex::new(VecDeque::with_capacity(STDERR_LINES_MAX)));
        let kept = Arc::clone(&last_lines);
        let words = std::thread::spawn(move || {
            lines_of(stderr).for_each(|line| {
                let mut kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
                if kept.len() == STDERR_LINES_MAX {
                    kept.pop_front();
                }
                kept.push_back(line);
            });
        });
        std::thread::spawn(move || {
            lines_of(stdout).for_each(on_line);
            // Whoever handles the end wants to report the last words, so they come first.
            let _ = words.join();
            on_closed();
        });
        Ok(ServerProcess { child, stderr: last_lines })
    }

    pub(super) fn id(&self) -> u32 {
        self.child.id()
    }

    pub(super) fn last_words(&self) -> String {
        let lines = self.stderr.lock().unwrap_or_else(PoisonError::into_inner);
        lines.iter().map(String::as_str).collect::<Vec<_>>().join("\n")
    }

    /// Returns at once, before the process has ended.
    pub(super) fn kill(&mut self) {
        // Only a process that has ended already cannot be killed.
        let _ = self.child.kill();
    }

    /// Kills the process unless it has ended by itself, and says in words how it ended.
    pub(super) fn end(mut self) -> String {
        self.kill();
        match self.child.wait() {
            Ok(status) => format!("{status}\n{}", self.last_words()),
            Err(error) => format!("unknown status ({error})\n{}", self.last_words()),
        }
    }
}

fn lines_of(stream: impl Read) -> impl Iterator<Item = String> {
    BufReader::new(stream).lines().map_while(IoResult::ok)
}

/// Lets the kernel kill the child when the calling thread ends, however it ends.
#[cfg(target_os = "linux")]
fn die_with_this_thread(command: &mut Command) {
    let parent = std::process::id();
    let request = move || {
        // SAFETY: plain system calls, allowed between fork and exec; they touch no memory.
        let (refused, parent_now) =
            unsafe { (libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL) != 0, libc::getppid()) };
        if refused {
            return Err(std::io::Error::last_os_error());
        }
        // A parent that died before the request above would never send the signal.
        if u32::try_from(parent_now) == Ok(parent) {
            Ok(())
        } else {
            Err(std::io::ErrorKind::NotConnected.into())
        }
    };
    // SAFETY: the closure allocates nothing and takes no lock, as the time after a fork demands.
    unsafe { command.pre_exec(request) };
}

/// Elsewhere the server's own `--exit-with-parent` is all there is.
#[cfg(not(target_os = "linux"))]
fn die_with_this_thread(_: &mut Command) {}
