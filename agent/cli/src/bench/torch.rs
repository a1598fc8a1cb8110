//! The other side of the comparison: a Python process that makes the same decisions with PyTorch.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};

/// A running `bench.py`.
#[derive(Debug)]
pub struct Torch {
    process: Child,
    requests: ChildStdin,
    replies: BufReader<ChildStdout>,
    /// What it said at its start.
    pub hello: Hello,
}

/// What it is and what it can be asked for.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hello {
    /// Of PyTorch.
    pub version: String,
    /// Of its thread pool.
    pub threads: usize,
    /// Ways to run the network; the first is eager.
    pub settings: Vec<String>,
    /// Settings that do not work here, and why.
    pub broken: Vec<String>,
}

#[derive(Debug, Serialize)]
struct Request<'a> {
    setting: &'a str,
    observation: usize,
    /// (candidates, tokens): each candidate's, so that both sides do the same steps.
    tokens: &'a [Vec<u32>],
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Answer {
    ms: f64,
}

impl Torch {
    /// Starts `script` with a Python that has PyTorch; it loads the policy and the observations itself.
    pub fn start(
        python: &Path,
        script: &Path,
        policy: &Path,
        observations: &Path,
    ) -> Result<Torch> {
        let mut process = Command::new(python)
            .arg(script)
            .args([policy, observations])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}", python.display()))?;
        let requests = process.stdin.take().context("no way to write to PyTorch's process")?;
        let replies = process.stdout.take().context("no way to read from PyTorch's process")?;
        let mut replies = BufReader::new(replies);
        let hello: Hello = read(&mut replies).with_context(|| {
            format!(
                "{} does not run {} (it needs torch, safetensors, tokenizers; --python names another Python)",
                python.display(),
                script.display()
            )
        })?;
        ensure!(!hello.settings.is_empty(), "PyTorch: expected a setting that works, got none");
        let torch = Torch { process, requests, replies, hello };
        torch.signal(libc::SIGSTOP)?;
        Ok(torch)
    }

    /// Stops or continues the process. PyTorch's threads spin on after their turn, on cores that ours is timed on.
    fn signal(&self, signal: libc::c_int) -> Result<()> {
        let process = libc::pid_t::try_from(self.process.id()).context("a process id is a pid")?;
        // SAFETY: a plain system call; the process is a child of ours that nobody has waited for.
        let result = unsafe { libc::kill(process, signal) };
        ensure!(result == 0, "PyTorch's process has ended");
        Ok(())
    }

    /// Milliseconds of one decision: prefill, then these tokens of each candidate, with logits and a draw each.
    pub fn decide(
        &mut self,
        setting: &str,
        observation: usize,
        tokens: &[Vec<u32>],
    ) -> Result<f64> {
        let request = serde_json::to_string(&Request { setting, observation, tokens })?;
        self.signal(libc::SIGCONT)?;
        writeln!(self.requests, "{request}").context("PyTorch's process has ended")?;
        self.requests.flush().context("PyTorch's process has ended")?;
        let answer: Answer = read(&mut self.replies)?;
        self.signal(libc::SIGSTOP)?;
        Ok(answer.ms)
    }
}

impl Drop for Torch {
    fn drop(&mut self) {
        // It has nothing to save, and it may be gone already.
        self.process.kill().ok();
        self.process.wait().ok();
    }
}

fn read<T: for<'de> Deserialize<'de>>(replies: &mut BufReader<ChildStdout>) -> Result<T> {
    let mut line = String::new();
    let count = replies.read_line(&mut line)?;
    ensure!(count > 0, "PyTorch's process has ended");
    serde_json::from_str(&line).with_context(|| format!("PyTorch's process said {line:?}"))
}
