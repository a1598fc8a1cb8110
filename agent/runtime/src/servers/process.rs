//! One server process: reads its pipes, keeps its last output, and kills it when this process ends.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result};
use rustix::io::Errno;
use rustix::process::{
    Pid, Resource, Signal, WaitId, WaitIdOptions, getrlimit, kill_process_group, waitid,
};

/// Maximum number of stderr lines in an error.
const STDERR_LINES_MAX: usize = 20;
/// Longer lines are split.
const LINE_BYTES_MAX: u64 = 4096;
/// How long to wait for the output of a process that has ended. Processes that it started may keep
/// its pipes open forever.
const LAST_WORDS_WAIT: Duration = Duration::from_secs(1);
/// What programs and libraries print when an allocation fails.
const MEMORY_WORDS: [&str; 5] = [
    "MemoryError",
    "bad_alloc",
    "Cannot allocate memory",
    "cannot allocate memory",
    "memory allocation of",
];

pub(super) struct ServerProcess {
    child: Child,
    stderr: Arc<Mutex<VecDeque<String>>>,
    is_killed: bool,
}

impl ServerProcess {
    /// Starts the process. `on_line` receives every line of standard output; after the last one
    /// `on_ended` is called once. The process is killed when the calling thread ends.
    pub(super) fn spawn(
        command: &mut Command,
        on_line: impl Fn(String) + Send + 'static,
        on_ended: impl FnOnce() + Send + 'static,
    ) -> Result<ServerProcess> {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        // Ctrl-C in a terminal reaches the whole process group. On Ctrl-C the agent finishes its
        // episodes and needs the servers for that.
        command.process_group(0);
        die_with_this_thread(command);
        let program = command.get_program().to_owned();
        let cannot = || format!("cannot start {}", program.display());
        let mut child = command.spawn().with_context(cannot)?;
        let stdout = child.stdout.take().context("the standard output is piped")?;
        let stderr = child.stderr.take().context("the standard error is piped")?;
        let id = pid(&child).with_context(cannot)?;
        let last_lines = Arc::new(Mutex::new(VecDeque::with_capacity(STDERR_LINES_MAX)));
        let kept = Arc::clone(&last_lines);
        let (reading, all_read) = channel();
        read_lines(stdout, reading.clone(), on_line);
        read_lines(stderr, reading, move |line| {
            let mut kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
            if kept.len() == STDERR_LINES_MAX {
                kept.pop_front();
            }
            kept.push_back(line);
        });
        thread::spawn(move || {
            wait_for_end(id, &all_read);
            on_ended();
        });
        Ok(ServerProcess { child, stderr: last_lines, is_killed: false })
    }

    pub(super) fn id(&self) -> u32 {
        self.child.id()
    }

    pub(super) fn last_words(&self) -> String {
        let lines = self.stderr.lock().unwrap_or_else(PoisonError::into_inner);
        lines.iter().map(String::as_str).collect::<Vec<_>>().join("\n")
    }

    /// Kills the process and its children. Does not wait: a process that waits for a device ends
    /// only when the device replies.
    pub(super) fn kill(&mut self) {
        self.is_killed = true;
        if let Some(id) = pid(&self.child) {
            // Fails only for processes that have already ended.
            let _ = kill_process_group(id, Signal::KILL);
        }
    }

    /// Describes how the process ended; to be called after `on_ended`.
    pub(super) fn end(mut self) -> String {
        let is_killed = self.is_killed;
        // Its children must not outlive it. Its process id is not reused before it is waited for.
        self.kill();
        let words = self.last_words();
        match self.child.wait() {
            Ok(status) => {
                let cause = if is_killed { None } else { memory_cause(status, &words) };
                let cause = cause.map(|cause| format!(" ({cause})")).unwrap_or_default();
                format!("{status}{cause}\n{words}").trim_end().to_owned()
            }
            Err(error) => format!("unknown status ({error})\n{words}"),
        }
    }
}

fn pid(child: &Child) -> Option<Pid> {
    i32::try_from(child.id()).ok().and_then(Pid::from_raw)
}

/// Waits until the process has ended and its output is read, without reaping the process.
fn wait_for_end(id: Pid, all_read: &Receiver<Infallible>) {
    let options = WaitIdOptions::EXITED | WaitIdOptions::NOWAIT;
    while waitid(WaitId::Pid(id), options).is_err_and(|error| error == Errno::INTR) {}
    // The channel closes when both pipes are read to their ends.
    let _ = all_read.recv_timeout(LAST_WORDS_WAIT);
}

/// Reads the stream to its end and removes control characters, because the lines may be shown in a
/// terminal.
fn read_lines(
    stream: impl Read + Send + 'static,
    reading: Sender<Infallible>,
    on_line: impl Fn(String) + Send + 'static,
) {
    thread::spawn(move || {
        let mut stream = BufReader::new(stream);
        let mut line = Vec::new();
        loop {
            line.clear();
            match stream.by_ref().take(LINE_BYTES_MAX).read_until(b'\n', &mut line) {
                Ok(0) | Err(_) => break,
                Ok(_) => {
                    let text = String::from_utf8_lossy(line.trim_ascii_end());
                    on_line(text.chars().filter(|character| !character.is_control()).collect());
                }
            }
        }
        drop(reading);
    });
}

/// Why a process that was not killed by the supervisor may have run out of memory.
fn memory_cause(status: ExitStatus, words: &str) -> Option<String> {
    let limit = getrlimit(Resource::As).current;
    let limited = limit.map(|bytes| {
        format!("memory per process is limited to {} MB, see `ulimit -v`", bytes / 1_000_000)
    });
    if MEMORY_WORDS.iter().any(|cry| words.contains(cry)) {
        return Some(limited.unwrap_or_else(|| "out of memory".to_owned()));
    }
    if status.signal() == Some(Signal::KILL.as_raw()) {
        return Some(
            "killed by another process, possibly by the kernel for lack of memory; see `dmesg`"
                .to_owned(),
        );
    }
    // With too little memory for its libraries a process fails in various ways.
    limited.filter(|_| !status.success())
}

/// Makes the kernel kill the child when the calling thread ends for any reason.
#[cfg(target_os = "linux")]
fn die_with_this_thread(command: &mut Command) {
    use rustix::process::{getpid, getppid, set_parent_process_death_signal};

    let parent = getpid();
    let request = move || {
        set_parent_process_death_signal(Some(Signal::KILL))?;
        // If the parent ended before the request above, the signal would never be sent.
        if getppid() == Some(parent) {
            Ok(())
        } else {
            Err(std::io::ErrorKind::NotConnected.into())
        }
    };
    // SAFETY: the closure does not allocate or lock, as required between fork and exec.
    unsafe { command.pre_exec(request) };
}

/// On other systems the server's own `--exit-with-parent` must suffice.
#[cfg(not(target_os = "linux"))]
fn die_with_this_thread(_: &mut Command) {}
