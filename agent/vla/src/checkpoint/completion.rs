//! Parses completions: text, reasoning, action and confidence of a candidate. Needs no weights.

use std::path::Path;

use anyhow::{Context, Result};
use decision::{ActionSpace, Malformed, Parsed};

use super::actions::ActionBins;
use super::config::{ACTION_LENGTH, Config};
use super::digest_cache::DigestCache;
use super::identity::Fingerprint;
use super::options::LoadOptions;
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
    pub fn load(directory: &Path, options: &LoadOptions) -> Result<CompletionParser> {
        CompletionParser::load_with(directory, options, |config| {
            let fingerprint = Fingerprint::of(directory, config)?;
            let cache = DigestCache::open(directory, None)?;
            if let Some(digest) = cache.digest(&fingerprint) {
                return Ok(digest);
            }
            let digest = fingerprint.identity(&Shards::open(directory)?, config)?;
            cache.keep(&fingerprint, &digest);
            Ok(digest)
        })
    }

    /// Loads what reads the records of a run, which were made with a checkpoint of this digest.
    /// The weights are not read: that the folder is the run's must show in the records.
    pub fn load_for_records(
        directory: &Path,
        options: &LoadOptions,
        digest: &str,
    ) -> Result<CompletionParser> {
        CompletionParser::load_with(directory, options, |_| Ok(digest.to_owned()))
    }

    /// Loads both files; `digest` has the checkpoint's identity.
    pub(crate) fn load_with(
        directory: &Path,
        options: &LoadOptions,
        digest: impl FnOnce(&Config) -> Result<String>,
    ) -> Result<CompletionParser> {
        let load = || -> Result<CompletionParser> {
            let config = Config::load(directory, options)?;
            let prompter = Prompter::load(&directory.join("tokenizer.json"), &config)?;
            let scale = config.action_scale.clone();
            let bins = ActionBins::new(config.vocabulary, config.action_bins, scale);
            let digest = digest(&config)?;
            Ok(CompletionParser { config, prompter, bins, digest })
        };
        load().with_context(|| format!("cannot load the policy in {}", directory.display()))
    }

    /// The checkpoint's identity: SHA-256 of its configuration, tokenizer and weights, in
    /// hexadecimal.
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// What the checkpoint is, as names and values to show.
    pub fn description(&self) -> Vec<(&'static str, String)> {
        let Config { towers, image_size, text, vocabulary, .. } = &self.config;
        let Config { reasoning, partial_reasoning, center_crop, .. } = &self.config;
        let towers: Vec<String> =
            towers.iter().map(|one| format!("{} x {}", one.depth, one.embed_dim)).collect();
        vec![
            ("image", format!("{image_size} x {image_size}")),
            ("vision blocks", towers.join(" and ")),
            ("decoder blocks", format!("{} x {}", text.num_hidden_layers, text.hidden_size)),
            ("vocabulary", vocabulary.to_string()),
            ("chain of thought", chain_of_thought(*reasoning, *partial_reasoning)),
            ("centre crop", if *center_crop { "90 % of the area" } else { "no" }.to_owned()),
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
        parse::parse(tokens, &self.config, &self.bins, &self.prompter)
    }

    /// The policy's confidence in each part of a candidate, from one log-probability per token.
    pub fn confidence(&self, tokens: &[u32], log_probabilities: &[f32]) -> Vec<f32> {
        confidence::confidence(tokens, log_probabilities, &self.bins, &self.prompter)
    }
}

fn chain_of_thought(is_written: bool, is_read_partly: bool) -> String {
    let text = match (is_written, is_read_partly) {
        (false, _) => "no",
        (true, false) => "yes, every section required",
        (true, true) => "yes, read as far as possible",
    };
    text.to_owned()
}
