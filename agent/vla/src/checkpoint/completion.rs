//! Parses completions: text, reasoning, action and confidence of a candidate. Needs no weights.

use std::path::Path;

use anyhow::{Context, Result};
use decision::{ActionSpace, Malformed, Parsed};

use super::actions::ActionBins;
use super::config::{ACTION_LENGTH, Config};
use super::digest_cache::DigestCache;
use super::identity::Fingerprint;
use super::prompt::Prompter;
use super::shards::Shards;
use super::{confidence, parse};

/// Everything in a checkpoint's configuration and tokenizer that is needed to parse completions.
pub struct CompletionParser {
    pub(crate) config: Config,
    pub(crate) prompter: Prompter,
    pub(crate) bins: ActionBins,
    pub(crate) digest: String,
}

impl CompletionParser {
    /// Loads config.json and tokenizer.json from a checkpoint folder and computes the checkpoint's
    /// identity.
    pub fn load(directory: &Path) -> Result<CompletionParser> {
        let load = || -> Result<CompletionParser> {
            let mut parser = CompletionParser::open(directory)?;
            let fingerprint = Fingerprint::of(directory, &parser.config)?;
            let cache = DigestCache::open(directory, None)?;
            parser.digest = match cache.digest(&fingerprint) {
                Some(digest) => digest,
                None => {
                    let shards = Shards::open(directory)?;
                    let digest = fingerprint.identity(&shards, &parser.config)?;
                    cache.keep(&fingerprint, &digest);
                    digest
                }
            };
            Ok(parser)
        };
        load().with_context(|| format!("cannot load the policy in {}", directory.display()))
    }

    /// Loads config.json and tokenizer.json; the identity is filled in by the caller.
    pub(crate) fn open(directory: &Path) -> Result<CompletionParser> {
        let config = Config::load(&directory.join("config.json"))?;
        let prompter = Prompter::load(&directory.join("tokenizer.json"), &config)?;
        let scale = config.action_scale.clone();
        let bins = ActionBins::new(config.vocabulary, config.action_bins, scale);
        Ok(CompletionParser { config, prompter, bins, digest: String::new() })
    }

    /// The checkpoint's identity: SHA-256 of its configuration, tokenizer and weights, in
    /// hexadecimal.
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// What the checkpoint is, as names and values to show.
    pub fn description(&self) -> Vec<(&'static str, String)> {
        let Config { towers, image_size, text, vocabulary, reasoning, .. } = &self.config;
        let towers: Vec<String> =
            towers.iter().map(|one| format!("{} x {}", one.depth, one.embed_dim)).collect();
        vec![
            ("image", format!("{image_size} x {image_size}")),
            ("vision blocks", towers.join(" and ")),
            ("decoder blocks", format!("{} x {}", text.num_hidden_layers, text.hidden_size)),
            ("vocabulary", vocabulary.to_string()),
            ("chain of thought", if *reasoning { "yes" } else { "no" }.to_owned()),
            ("tokens at most", self.config.completion_tokens_max.to_string()),
            ("prompt", format!("{:?}", self.config.prompt_template)),
            ("action", format!("{ACTION_LENGTH} numbers, {} bins each", self.config.action_bins)),
        ]
    }

    /// Length of a candidate's hidden state.
    pub fn hidden_size(&self) -> usize {
        self.config.text.hidden_size
    }

    /// The dimensions of the checkpoint's actions and their units.
    pub fn action_space(&self) -> ActionSpace {
        ActionSpace { scale: self.bins.units().to_vec(), gripper: Some(ACTION_LENGTH - 1) }
    }

    /// The text of a candidate's tokens.
    pub fn text(&self, tokens: &[u32]) -> String {
        self.prompter.text(tokens)
    }

    /// Parses a candidate's tokens (without `</s>`) as reasoning and action.
    pub fn parse(&self, tokens: &[u32]) -> Result<Parsed, Malformed> {
        parse::parse(tokens, self.config.reasoning, &self.bins, &self.prompter)
    }

    /// The policy's confidence in each part of a candidate, from one log-probability per token.
    pub fn confidence(&self, tokens: &[u32], log_probabilities: &[f32]) -> Vec<f32> {
        confidence::confidence(tokens, log_probabilities, &self.bins, &self.prompter)
    }
}
