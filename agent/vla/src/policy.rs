//! A checkpoint as a policy.

use std::borrow::Cow;
use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use async_trait::async_trait;
use candle_core::{Device, Tensor};
use decision::{Candidate, Image, Policy, PolicyInfo, Proposal, ProposalRequest};

use crate::checkpoint::completion::CompletionParser;
use crate::checkpoint::config::{ACTION_LENGTH, Config, TowerConfig};
use crate::checkpoint::digest_cache::DigestCache;
use crate::checkpoint::identity::{Fingerprint, used_tensors};
use crate::checkpoint::options::LoadOptions;
use crate::checkpoint::shards::Shards;
use crate::checkpoint::weights::{Loaded, Target, Weights};
use crate::generate::decode_loop::{Continuation, Limits};
use crate::generate::timings::{self, Timings};
use crate::generate::worker_pools::WorkerPools;
use crate::kernels::backend::Backend;
use crate::kernels::device::DeviceName;
use crate::kernels::matmul::WeightFormat;
use crate::network::center_crop::center_crop;
use crate::network::decoder::Wanted;
use crate::network::forward::{Context, Network};
use crate::network::trace::Trace;

/// Tokens of an instruction, for the size of caches; SIMPLER's have about ten.
const INSTRUCTION_TOKENS: usize = 64;

/// A loaded checkpoint.
pub struct Vla {
    pub(crate) parser: CompletionParser,
    pub(crate) network: Network,
    pools: WorkerPools,
    info: PolicyInfo,
}

/// Where and how the weights of a checkpoint are loaded.
#[derive(Clone, Copy)]
pub struct Loading<'a> {
    /// The device of the network.
    pub device: DeviceName,
    /// The format of the decoder's matrices.
    pub weights: WeightFormat,
    /// Folder for the digests of checkpoints in folders that cannot be written.
    pub digests: Option<&'a Path>,
    /// Called after each tensor.
    pub report: &'a dyn Fn(Loaded),
}

impl Default for Loading<'_> {
    fn default() -> Self {
        Loading {
            device: DeviceName::Cpu,
            weights: WeightFormat::Exact,
            digests: None,
            report: &|_| {},
        }
    }
}

impl Vla {
    /// Loads a checkpoint folder onto a device: config.json, model.safetensors (or shards),
    /// tokenizer.json.
    pub fn load(directory: &Path, device: DeviceName, options: &LoadOptions) -> Result<Vla> {
        Vla::load_with(directory, options, &Loading { device, ..Loading::default() })
    }

    /// Loads a checkpoint folder. Tensors are read one at a time, and hashed while the network is
    /// made of them unless the digest is known.
    pub fn load_with(
        directory: &Path,
        options: &LoadOptions,
        loading: &Loading<'_>,
    ) -> Result<Vla> {
        let device = loading.device.open()?;
        let (backend, format) = (Backend::for_device(&device), loading.weights);
        ensure!(
            format == WeightFormat::Exact || backend == Backend::Kernels,
            "weights in 8 bits: expected the device cpu, got {}",
            loading.device
        );
        Vla::load_onto(directory, options, Target { device, backend, format }, loading)
    }

    /// Loads a checkpoint folder onto an open device, with the given backend.
    pub fn load_on(
        directory: &Path,
        device: &Device,
        backend: Backend,
        options: &LoadOptions,
    ) -> Result<Vla> {
        let target = Target { device: device.clone(), backend, format: WeightFormat::Exact };
        Vla::load_onto(directory, options, target, &Loading::default())
    }

    pub(crate) fn load_onto(
        directory: &Path,
        options: &LoadOptions,
        target: Target,
        loading: &Loading<'_>,
    ) -> Result<Vla> {
        let load = || -> Result<Vla> {
            let none = |_: &Config| Ok(String::new());
            let mut parser = CompletionParser::load_with(directory, options, none)?;
            let fingerprint = Fingerprint::of(directory, &parser.config)?;
            let cache = DigestCache::open(directory, loading.digests)?;
            let shards = Shards::open(directory)?;
            let known = cache.digest(&fingerprint);
            let hashing = match known {
                Some(_) => None,
                None => Some(fingerprint.start(&shards, &parser.config)?),
            };
            let used = used_tensors(&shards, &parser.config);
            let backend = target.backend;
            let weights = Weights::new(&shards, &used, hashing, target, loading.report);
            let (network, rest) = Network::load(weights, &parser.config)?;
            if let Some(digest) = &rest.digest {
                cache.keep(&fingerprint, digest);
            }
            parser.digest = rest.digest.or(known).context("the digest was not computed")?;
            tracing::debug!(
                rest.dead_weights,
                rest.bytes_read_again,
                digest = parser.digest(),
                "policy loaded"
            );
            let pools = WorkerPools::new(backend)?;
            let info = PolicyInfo {
                digest: parser.digest().to_owned(),
                image_size: (parser.config.image_size, parser.config.image_size),
                action_space: parser.action_space(),
                hidden_size: Some(parser.hidden_size()),
                parallel_calls: pools.count().max(1),
            };
            Ok(Vla { parser, network, pools, info })
        };
        load().with_context(|| format!("cannot load the policy in {}", directory.display()))
    }

    /// The parser of this checkpoint's completions.
    pub fn parser(&self) -> &CompletionParser {
        &self.parser
    }

    /// Samples candidates for all requests in one batch. Blocks the calling thread.
    pub fn propose_now(&self, requests: &[ProposalRequest<'_>]) -> Result<Vec<Proposal>> {
        let given = vec![[].as_slice(); requests.len()];
        self.complete(requests, &given)
    }

    /// The candidates of all requests. The actions of a request's candidates may be given; then the
    /// network chooses only what comes before them.
    pub(crate) fn complete(
        &self,
        requests: &[ProposalRequest<'_>],
        given: &[&[[u32; ACTION_LENGTH]]],
    ) -> Result<Vec<Proposal>> {
        if requests.is_empty() {
            return Ok(Vec::new());
        }
        let prompts = requests.iter().map(|request| self.check(request));
        let prompts: Vec<Vec<u32>> = prompts.collect::<Result<_>>()?;
        let images = self.images(requests.iter().map(|request| request.image));
        let sessions: Vec<Continuation<'_>> = requests
            .iter()
            .zip(given)
            .zip(prompts.iter().zip(&images))
            .map(|((request, actions), (ids, image))| Continuation {
                context: Context { image, ids },
                candidates: request.candidates,
                temperature: request.temperature,
                seed: request.seed,
                tokens_max: self.tokens_max(ids.len()),
                actions,
            })
            .collect();
        let limits = Limits {
            bins: &self.parser.bins,
            vocabulary: self.parser.config.vocabulary,
            end: self.parser.config.text.eos_token_id,
            action_ends: !self.parser.config.reasoning,
        };
        let completions = self.pools.complete(&self.network, &sessions, &limits)?;
        let mut proposals: Vec<Proposal> =
            requests.iter().map(|_| Proposal { candidates: Vec::new() }).collect();
        for completion in completions {
            proposals[completion.session].candidates.push(Candidate {
                parsed: self.parser.parse(&completion.tokens),
                confidence: self
                    .parser
                    .confidence(&completion.tokens, &completion.log_probabilities),
                log_probability: completion.log_probability as f32,
                log_probabilities: completion.log_probabilities,
                tokens: completion.tokens,
                hidden: completion.hidden,
            });
        }
        Ok(proposals)
    }

    /// Outputs of every layer under the checkpoint's names, then the `logits` of all positions.
    pub fn activations(&self, image: &Image, ids: &[u32]) -> Result<Vec<(String, Tensor)>> {
        self.check_image(image)?;
        let mut trace = Trace::on();
        let images = self.images([image].into_iter());
        let contexts = [Context { image: &images[0], ids }];
        let (_, hidden) = self.network.prefill(&contexts, Wanted::All, &mut trace)?;
        trace.record(|| "logits".to_string(), &self.network.decoder.logits(&hidden)?);
        Ok(trace.into_outputs()?)
    }

    /// Measures the time of prefill and decode steps of these requests, with `tokens` tokens per
    /// candidate.
    pub fn time(&self, requests: &[ProposalRequest<'_>], tokens: usize) -> Result<Timings> {
        let prompts = requests.iter().map(|request| self.check(request));
        let prompts: Vec<Vec<u32>> = prompts.collect::<Result<_>>()?;
        let images = self.images(requests.iter().map(|request| request.image));
        let contexts: Vec<Context<'_>> =
            images.iter().zip(&prompts).map(|(image, ids)| Context { image, ids }).collect();
        let candidates = requests.first().map_or(1, |request| request.candidates);
        timings::measure(&self.network, &contexts, candidates, tokens)
    }

    /// Bytes of weights that one decode step reads, independent of the number of rows.
    pub fn step_bytes(&self) -> usize {
        self.network.decoder.step_bytes()
    }

    /// Bytes of keys and values of one session with this number of candidates, for an instruction of
    /// at most [`INSTRUCTION_TOKENS`]: image and prompt once, a completion of maximum length for each.
    pub fn cache_bytes(&self, candidates: usize) -> Result<usize> {
        let side = self.parser.config.towers.first().map_or(0, TowerConfig::side);
        let prompt = self.parser.prompter.ids("")?.len() + INSTRUCTION_TOKENS;
        let tail = self.tokens_max(prompt) + 1;
        Ok(self.network.decoder.cache_bytes(side * side + prompt, candidates, tail))
    }

    /// Maximum number of tokens after a prompt of this length and the image.
    pub(crate) fn tokens_max(&self, prompt_ids: usize) -> usize {
        let side = self.parser.config.towers[0].side();
        let room = self.network.decoder.positions_max().saturating_sub(prompt_ids + side * side);
        self.parser.config.completion_tokens_max.min(room)
    }

    /// The images as the network sees them.
    fn images<'a>(&self, images: impl Iterator<Item = &'a Image>) -> Vec<Cow<'a, Image>> {
        let seen = |image: &'a Image| match self.parser.config.center_crop {
            true => Cow::Owned(center_crop(image)),
            false => Cow::Borrowed(image),
        };
        images.map(seen).collect()
    }

    /// Checks a request and returns its prompt.
    fn check(&self, request: &ProposalRequest<'_>) -> Result<Vec<u32>> {
        self.check_image(request.image)?;
        ensure!(request.candidates > 0, "candidates: expected at least 1, got 0");
        ensure!(
            request.temperature.is_finite() && request.temperature >= 0.0,
            "temperature: expected 0 or more, got {}",
            request.temperature
        );
        self.parser.prompter.ids(request.instruction)
    }

    fn check_image(&self, image: &Image) -> Result<()> {
        let (height, width) = self.info.image_size;
        ensure!(
            (image.height, image.width) == (height, width),
            "image: expected {height} x {width} pixels, got {} x {}; request images of that size from the server",
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

#[async_trait]
impl Policy for Vla {
    fn info(&self) -> &PolicyInfo {
        &self.info
    }

    /// Computes in the calling thread: on all cores, or on one core if other calls are running.
    async fn propose(&self, requests: &[ProposalRequest<'_>]) -> Result<Vec<Proposal>> {
        self.propose_now(requests)
    }

    fn text(&self, candidate: &Candidate) -> Option<String> {
        Some(self.parser.text(&candidate.tokens))
    }
}
