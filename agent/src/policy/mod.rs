//! The policy: an image and an instruction in, candidates of reasoning and action out.
//!
//! ```text
//! image ─▶ pixels ─▶ vision ─▶ projector ─┐
//! instruction ─▶ prompt ──────────────────┴▶ decoder.prefill ─▶ shared prefix ─┐
//!                                            decoder.step x N candidates ◀─────┘─▶ sampling
//! tokens ─▶ candidate (reasoning, actions) or what is malformed about it
//! ```
//!
//! Weights never change; caches are values passed in. What a request gets does not depend on the
//! requests beside it.

use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use candle_core::{Device, Tensor};
use sha2::{Digest, Sha256};

// What a checkpoint says, and its tensors.
mod config;
mod weights;

// The network, from the outside in.
mod cache;
mod decoder;
mod network;
mod pixels;
mod projector;
mod trace;
mod vision;

// What its layers are made of.
mod activation;
mod attention;
pub mod backend;
mod device;
mod linear;
mod matmul;
mod norm;
mod rotary;
mod segment;
mod tile;

// Tokens: prompts in, draws, meaning.
mod actions;
mod candidate;
mod confidence;
mod generation;
mod lanes;
mod prompt;
mod reasoning;
mod sampling;

// How long it takes.
mod timings;

pub use backend::Backend;
pub use candidate::{Candidate, Parsed, Proposal, ProposalRequest};
pub use confidence::{Confidence, PARTS};
pub use device::DeviceName;
pub use protocol::message::Image;
pub use reasoning::{Malformed, Reasoning, VisibleObject};
pub use timings::Timings;

use actions::ActionBins;
use config::{ACTION_LENGTH, Config};
use decoder::Wanted;
use generation::{Continuation, Limits};
use lanes::Lanes;
use network::{Context, Network};
use prompt::Prompter;
use trace::Trace;

/// A loaded checkpoint.
pub struct Policy {
    config: Config,
    network: Network,
    prompter: Prompter,
    bins: ActionBins,
    lanes: Lanes,
    digest: String,
}

impl Policy {
    /// Loads a checkpoint's folder onto a device: config.json, model.safetensors (or shards), tokenizer.json.
    pub fn load(directory: &Path, device: DeviceName) -> Result<Policy> {
        let device = device.open()?;
        Policy::load_on(directory, &device, Backend::for_device(&device))
    }

    /// Loads it onto an open device, computing as told.
    pub fn load_on(directory: &Path, device: &Device, backend: Backend) -> Result<Policy> {
        let load = || -> Result<Policy> {
            let config = Config::load(&directory.join("config.json"))?;
            let network = Network::load(directory, &config, device, backend)?;
            let prompter = Prompter::load(&directory.join("tokenizer.json"), &config)?;
            let scale = config.action_scale.clone();
            let bins = ActionBins::new(config.vocabulary, config.action_bins, scale);
            let digest = digest(directory)?;
            tracing::debug!(dead_weights = network.dead_weights, digest, "policy loaded");
            let lanes = Lanes::new(backend)?;
            Ok(Policy { config, network, prompter, bins, lanes, digest })
        };
        load().with_context(|| format!("cannot load the policy in {}", directory.display()))
    }

    /// Height and width of the images it wants.
    pub fn image_size(&self) -> (usize, usize) {
        (self.config.image_size, self.config.image_size)
    }

    /// SHA-256 of weights, config and tokenizer, in hexadecimal.
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// Length of a candidate's hidden state.
    pub fn hidden_size(&self) -> usize {
        self.config.text.hidden_size
    }

    /// What counts as one unit of each number of an action: q99 - q01, and 2 for the gripper.
    pub fn action_scale(&self) -> [f32; ACTION_LENGTH] {
        self.bins.units()
    }

    /// The text of a candidate's tokens.
    pub fn decode_text(&self, tokens: &[u32]) -> String {
        self.prompter.text(tokens)
    }

    /// Reads a candidate's tokens (without `</s>`) as reasoning and action.
    pub fn parse(&self, tokens: &[u32]) -> Result<Parsed, Malformed> {
        candidate::parse(tokens, self.config.reasoning, &self.bins, &self.prompter)
    }

    /// How sure the policy was of each part of a candidate; one log-probability per token.
    pub fn confidence(&self, tokens: &[u32], log_probabilities: &[f32]) -> Confidence {
        confidence::confidence(tokens, log_probabilities, &self.bins, &self.prompter)
    }

    /// Samples the candidates of every request; all requests share the network's products.
    pub fn propose(&self, requests: &[ProposalRequest<'_>]) -> Result<Vec<Proposal>> {
        if requests.is_empty() {
            return Ok(Vec::new());
        }
        let prompts = requests.iter().map(|request| self.check(request));
        let prompts: Vec<Vec<u32>> = prompts.collect::<Result<_>>()?;
        let sessions: Vec<Continuation<'_>> = requests
            .iter()
            .zip(&prompts)
            .map(|(request, ids)| Continuation {
                context: Context { image: request.image, ids },
                candidates: request.candidates,
                temperature: request.temperature,
                seed: request.seed,
                tokens_max: self.tokens_max(ids.len()),
            })
            .collect();
        let limits = Limits {
            bins: &self.bins,
            vocabulary: self.config.vocabulary,
            end: self.config.text.eos_token_id,
        };
        let completions = self.lanes.complete(&self.network, &sessions, &limits)?;
        let mut proposals: Vec<Proposal> =
            requests.iter().map(|_| Proposal { candidates: Vec::new() }).collect();
        for completion in completions {
            proposals[completion.session].candidates.push(Candidate {
                parsed: self.parse(&completion.tokens),
                log_probability: completion.log_probability as f32,
                log_probabilities: completion.log_probabilities,
                tokens: completion.tokens,
                hidden: completion.hidden,
            });
        }
        Ok(proposals)
    }

    /// Outputs of every layer by the checkpoint's names, then `logits` of all positions.
    pub fn activations(&self, image: &Image, ids: &[u32]) -> Result<Vec<(String, Tensor)>> {
        self.check_image(image)?;
        let mut trace = Trace::on();
        let contexts = [Context { image, ids }];
        let (_, hidden) = self.network.prefill(&contexts, Wanted::All, &mut trace)?;
        trace.record(|| "logits".to_string(), &self.network.decoder.logits(&hidden)?);
        Ok(trace.into_outputs()?)
    }

    /// Times prefill and steps of these requests, for so many tokens of every candidate.
    pub fn time(&self, requests: &[ProposalRequest<'_>], tokens: usize) -> Result<Timings> {
        let prompts = requests.iter().map(|request| self.check(request));
        let prompts: Vec<Vec<u32>> = prompts.collect::<Result<_>>()?;
        let contexts: Vec<Context<'_>> = requests
            .iter()
            .zip(&prompts)
            .map(|(request, ids)| Context { image: request.image, ids })
            .collect();
        let candidates = requests.first().map_or(1, |request| request.candidates);
        timings::measure(&self.network, &contexts, candidates, tokens)
    }

    /// Bytes of weights that one token step reads, whatever the number of rows.
    pub fn step_bytes(&self) -> usize {
        self.network.decoder.step_bytes()
    }

    /// Tokens that may follow a prompt of so many ids and the image.
    fn tokens_max(&self, prompt_ids: usize) -> usize {
        let side = self.config.towers[0].side();
        let room = self.network.decoder.positions_max().saturating_sub(prompt_ids + side * side);
        self.config.completion_tokens_max.min(room)
    }

    /// The prompt of a request that can be answered.
    fn check(&self, request: &ProposalRequest<'_>) -> Result<Vec<u32>> {
        self.check_image(request.image)?;
        ensure!(request.candidates > 0, "candidates: expected at least 1, got 0");
        ensure!(
            request.temperature.is_finite() && request.temperature >= 0.0,
            "temperature: expected 0 or more, got {}",
            request.temperature
        );
        self.prompter.ids(request.instruction)
    }

    fn check_image(&self, image: &Image) -> Result<()> {
        let (height, width) = self.image_size();
        ensure!(
            (image.height, image.width) == (height, width),
            "image: expected {height} x {width} pixels, got {} x {}; ask the server for that size",
            image.height,
            image.width
        );
        let length = height * width * 3;
        ensure!(
            image.pixels.len() == length,
            "image: expected {length} bytes, got {}",
            image.pixels.len()
        );
        Ok(())
    }
}

fn digest(directory: &Path) -> Result<String> {
    let mut hasher = Sha256::new();
    let mut files = vec![directory.join("config.json"), directory.join("tokenizer.json")];
    files.extend(weights::weight_files(directory)?);
    for file in files {
        let bytes =
            std::fs::read(&file).with_context(|| format!("cannot read {}", file.display()))?;
        hasher.update((bytes.len() as u64).to_le_bytes());
        hasher.update(&bytes);
    }
    Ok(hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests;
