//! `rever bench`: how long decisions take on this machine, by sessions and candidates.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::{Args, ValueEnum};

use crate::policy::{Image, Policy, ProposalRequest};

const SESSIONS: [usize; 3] = [1, 8, 16];
const CANDIDATES: [usize; 5] = [1, 2, 5, 8, 16];
/// Tokens per candidate when parts are timed: the shipped model's reasoning, action and end.
const TOKENS: usize = 25;
const INSTRUCTION: &str = "put the spoon on the towel";

/// Time a part of the program.
#[derive(Debug, Args)]
pub struct Arguments {
    /// What to time
    what: What,
    /// Folder of the policy
    #[arg(long, default_value = "agent/models/bridge-small")]
    policy: PathBuf,
    /// Runs of each cell, of which the fastest counts
    #[arg(long, default_value_t = 5)]
    repeats: usize,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum What {
    /// One decision: image and prompt, then every token of every candidate
    Decision,
}

/// Prints one line per number of sessions and candidates.
pub fn run(arguments: Arguments) -> Result<()> {
    let Arguments { what: What::Decision, policy, repeats } = arguments;
    let policy = Policy::load(&policy)?;
    let (height, width) = policy.image_size();
    let byte = |index: usize| (index % 251) as u8;
    let image = Image { height, width, pixels: (0..height * width * 3).map(byte).collect() };
    println!("sessions  candidates  prefill ms  step ms  {TOKENS} tokens ms  sampled decision ms");
    for sessions in SESSIONS {
        for candidates in CANDIDATES {
            let request = |seed| ProposalRequest {
                image: &image,
                instruction: INSTRUCTION,
                candidates,
                temperature: 1.0,
                seed,
            };
            let requests: Vec<ProposalRequest<'_>> = (0..sessions as u64).map(request).collect();
            let (mut prefill, mut step) = (f64::INFINITY, f64::INFINITY);
            let mut decision = f64::INFINITY;
            for _ in 0..repeats {
                let timings = policy.time(&requests, TOKENS)?;
                prefill = prefill.min(timings.prefill_ms);
                step = step.min(timings.step_ms);
                let start = Instant::now();
                policy.propose(&requests)?;
                decision = decision.min(start.elapsed().as_secs_f64() * 1e3);
            }
            let whole = prefill + TOKENS as f64 * step;
            println!(
                "{sessions:8}  {candidates:10}  {prefill:10.2}  {step:7.2}  {whole:12.1}  {decision:19.1}"
            );
        }
    }
    Ok(())
}
