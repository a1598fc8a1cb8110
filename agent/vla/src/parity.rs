//! What another implementation of the same network is compared with.

use anyhow::{Context as _, Result};
use decision::{Image, ProposalRequest};

use crate::policy::Vla;

/// The greedy completion of one observation, and what led to it.
#[derive(Debug)]
pub struct GreedyTrace {
    /// Ids of the prompt, without those of the image.
    pub prompt: Vec<u32>,
    /// Greedy tokens, without `</s>`.
    pub tokens: Vec<u32>,
    /// (tokens + 1, vocabulary with padding): what each token was chosen from, and the one after
    /// the last.
    pub logits: Vec<f32>,
    /// Size of a row of logits.
    pub vocabulary: usize,
    /// The action that would be executed, or why there is none.
    pub action: Result<Vec<f32>, String>,
}

impl Vla {
    /// Completes a prompt with the most likely tokens; then computes the logits along them in one
    /// pass over the whole sequence.
    pub fn greedy_trace(&self, image: &Image, instruction: &str) -> Result<GreedyTrace> {
        let request = ProposalRequest {
            image,
            state: &[],
            instruction,
            candidates: 1,
            temperature: 0.0,
            seed: 0,
            episode: None,
        };
        let candidate =
            self.propose_now(&[request])?.pop().and_then(|mut all| all.candidates.pop());
        let candidate = candidate.context("no candidate")?;
        let prompt = self.parser.prompter.ids(instruction)?;
        let ids = [&prompt[..], &candidate.tokens].concat();
        let (_, logits) = self.activations(image, &ids)?.pop().context("no logits")?;
        let (positions, vocabulary) = logits.dims2()?;
        let rows = candidate.tokens.len() + 1;
        let logits = logits.narrow(0, positions - rows, rows)?.flatten_all()?.to_vec1()?;
        let action = candidate.parsed.map(|parsed| parsed.actions.first().to_vec());
        let action = action.map_err(|malformed| malformed.to_string());
        Ok(GreedyTrace { prompt, tokens: candidate.tokens, logits, vocabulary, action })
    }
}
