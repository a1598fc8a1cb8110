//! The PyTorch baseline: a Python process that makes the same decisions.

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
    /// What the process reported at its start.
    pub hello: Hello,
}

/// PyTorch's version and the settings that it supports.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hello {
    /// Version of PyTorch.
    pub version: String,
    /// Threads of PyTorch's pool.
    pub threads: usize,
    /// Ways to run the network; the first is eager.
    pub settings: Vec<String>,
    /// Settings that do not work on this machine, and why.
    pub broken: Vec<String>,
}

#[derive(Debug, Serialize)]
struct Request<'a> {
    setting: &'a str,
    observation: usize,
    /// (candidates, tokens): the tokens of each candidate, so that both sides do the same steps.
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
        let requests = process.stdin.take().context("cannot write to the PyTorch process")?;
        let replies = process.stdout.take().context("cannot read from the PyTorch process")?;
        let mut replies = BufReader::new(replies);
        let hello: Hello = read(&mut replies).with_context(|| {
            format!(
                "{} does not run {} (it needs torch, safetensors and tokenizers; choose another Python with --python)",
                python.display(),
                script.display()
            )
        })?;
        ensure!(
            !hello.settings.is_empty(),
            "--compare: PyTorch could not run the policy in any setting"
        );
        let torch = Torch { process, requests, replies, hello };
        torch.signal(libc::SIGSTOP)?;
        Ok(torch)
    }

    /// Stops or continues the process. PyTorch's idle threads keep spinning and would take cores from rever.
    fn signal(&self, signal: libc::c_int) -> Result<()> {
        let process =
            libc::pid_t::try_from(self.process.id()).context("process id out of range")?;
        // SAFETY: a plain system call. The process is our child and not yet waited for, so its id is not reused.
        let result = unsafe { libc::kill(process, signal) };
        ensure!(result == 0, "the PyTorch process has ended");
        Ok(())
    }

    /// Milliseconds of one decision: prefill, then these tokens of each candidate, each with logits and sampling.
    pub fn decide(
        &mut self,
        setting: &str,
        observation: usize,
        tokens: &[Vec<u32>],
    ) -> Result<f64> {
        let request = serde_json::to_string(&Request { setting, observation, tokens })?;
        self.signal(libc::SIGCONT)?;
        writeln!(self.requests, "{request}").context("the PyTorch process has ended")?;
        self.requests.flush().context("the PyTorch process has ended")?;
        let answer: Answer = read(&mut self.replies)?;
        self.signal(libc::SIGSTOP)?;
        Ok(answer.ms)
    }
}

impl Drop for Torch {
    fn drop(&mut self) {
        // The process has nothing to save, and it may have ended already.
        self.process.kill().ok();
        self.process.wait().ok();
    }
}

fn read<T: for<'de> Deserialize<'de>>(replies: &mut BufReader<ChildStdout>) -> Result<T> {
    let mut line = String::new();
    let count = replies.read_line(&mut line)?;
    ensure!(count > 0, "the PyTorch process has ended");
    serde_json::from_str(&line)
        .with_context(|| format!("unexpected reply of the PyTorch process: {line:?}"))
}
