//! How long the parts of a decision take, apart from what the tokens say.

use std::time::Instant;

use anyhow::Result;

use crate::network::forward::{Context, Network};

/// Milliseconds of one decision's parts.
#[derive(Debug, Clone, Copy)]
pub struct Timings {
    /// Image, prompt and the first logits of every session.
    pub prefill_ms: f64,
    /// One token of every candidate, with its logits; the mean over all steps.
    pub step_ms: f64,
}

/// Runs every context with so many candidates each, for so many tokens, whatever they are.
pub fn measure(
    network: &Network,
    contexts: &[Context<'_>],
    candidates: usize,
    tokens: usize,
) -> Result<Timings> {
    // As `Lanes::complete` runs one lane.
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
    // A graphics card works on after the call has returned.
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
