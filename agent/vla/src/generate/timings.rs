//! Times of the parts of a decision, independent of the generated tokens.

use std::time::Instant;

use anyhow::Result;

use crate::network::forward::{Context, Network};

/// Times of the parts of one decision, in milliseconds.
#[derive(Debug, Clone, Copy)]
pub struct Timings {
    /// Image, prompt and first logits of all sessions.
    pub prefill_ms: f64,
    /// One token of every candidate with its logits; the mean over all steps.
    pub step_ms: f64,
}

/// Runs every context with this number of candidates and tokens.
pub fn measure(
    network: &Network,
    contexts: &[Context<'_>],
    candidates: usize,
    tokens: usize,
) -> Result<Timings> {
    // As in `WorkerPools::complete` without dividing the sessions.
    rayon::scope(|_| measure_inside(network, contexts, candidates, tokens))
}

fn measure_inside(
    network: &Network,
    contexts: &[Context<'_>],
    candidates: usize,
    tokens: usize,
) -> Result<Timings> {
    let start = Instant::now();
    let (prefix, hidden) = network.prefill_all(contexts)?;
    // A GPU may still be computing after the call has returned.
    network.decoder.logits(&hidden)?.device().synchronize()?;
    let prefill_ms = start.elapsed().as_secs_f64() * 1e3;
    let sessions: Vec<usize> =
        (0..contexts.len() * candidates).map(|row| row / candidates).collect();
    let ids = vec![contexts[0].ids[0]; sessions.len()];
    let start = Instant::now();
    let mut tail = network.decoder.tails(sessions, tokens);
    for _ in 0..tokens {
        let hidden = network.decoder.step(&ids, &prefix, &mut tail)?;
        network.decoder.logits(&hidden)?.device().synchronize()?;
    }
    let step_ms = start.elapsed().as_secs_f64() * 1e3 / tokens as f64;
    Ok(Timings { prefill_ms, step_ms })
}
