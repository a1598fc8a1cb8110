//! The fields of `config.json` that determine the layout. Fields that matter only for training are
//! ignored.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use serde::Deserialize;
use serde_json::Value;

use super::{ACTION_LENGTH, Config, TextConfig, TowerConfig, family, prompt, statistics};
use crate::checkpoint::options::LoadOptions;

/// Maximum tokens of a completion if the checkpoint states no limit; this is ECoT's own limit.
const REASONING_TOKENS_MAX: usize = 1024;

#[derive(Deserialize)]
pub struct File {
    #[serde(default)]
    pub llm_backbone_id: String,
    timm_model_ids: Vec<String>,
    #[serde(default)]
    timm_override_act_layers: Vec<Option<String>>,
    use_fused_vision_backbone: bool,
    image_sizes: Vec<usize>,
    image_resize_strategy: String,
    vision_config: Option<TowerConfig>,
    fused_vision_config: Option<TowerConfig>,
    text_config: TextConfig,
    pad_to_multiple_of: usize,
    n_action_bins: usize,
    #[serde(default)]
    pub norm_stats: BTreeMap<String, Value>,
    pub unnorm_key: Option<String>,
    pub prompt_template: Option<String>,
    pub reasoning: Option<bool>,
    /// Refuses a chain of thought that is not in ECoT's form, together with its action.
    #[serde(default)]
    reasoning_strict: bool,
    max_new_tokens: Option<usize>,
    #[serde(default)]
    center_crop: bool,
}

impl Config {
    /// Loads and checks the configuration of a checkpoint's folder. Options take precedence over
    /// its files.
    pub fn load(directory: &Path, options: &LoadOptions) -> Result<Config> {
        let path = directory.join("config.json");
        let name = path.display();
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) => {
                family::refuse_without_config(directory)?;
                return Err(error).with_context(|| format!("cannot read {name}"));
            }
        };
        let parse = || -> Result<Config> {
            let value: Value = serde_json::from_str(&text)?;
            family::check(directory, &value)?;
            let file: File = serde_json::from_str(&text)?;
            file.config(directory, options)
        };
        parse().with_context(|| format!("cannot use {name}"))
    }
}

impl File {
    fn config(self, directory: &Path, options: &LoadOptions) -> Result<Config> {
        ensure!(
            self.timm_override_act_layers.iter().all(Option::is_none),
            "timm_override_act_layers: expected null for every tower, got {:?}",
            self.timm_override_act_layers
        );
        ensure!(
            ["resize-naive", "letterbox"].contains(&self.image_resize_strategy.as_str()),
            "image_resize_strategy: expected resize-naive or letterbox, got {}",
            self.image_resize_strategy
        );
        let towers = self.towers()?;
        let image_size = towers[0].image_size;
        ensure!(
            self.image_sizes.iter().all(|&size| size == image_size)
                && towers.iter().all(|tower| tower.image_size == image_size),
            "image_sizes: expected {image_size} for every tower, got {:?}",
            self.image_sizes
        );
        self.text_config.check()?;
        let vocabulary = self.text_config.vocab_size.saturating_sub(self.pad_to_multiple_of);
        ensure!(
            self.n_action_bins == 256 && vocabulary > 256,
            "n_action_bins: expected 256 and a vocabulary of more than 256 tokens, got {} and {vocabulary}",
            self.n_action_bins
        );
        let datasets = statistics::Datasets::find(directory, &self.norm_stats)?;
        let action_scale = datasets.action_scale(options, self.unnorm_key.as_deref())?;
        let prompt = prompt::choose(&self, &towers, datasets.are_of_config(), options)?;
        let limit = if prompt.reasoning { REASONING_TOKENS_MAX } else { ACTION_LENGTH + 1 };
        let completion_tokens_max = options.max_new_tokens.or(self.max_new_tokens).unwrap_or(limit);
        ensure!(completion_tokens_max > 0, "max_new_tokens: expected at least 1, got 0");
        Ok(Config {
            image_size,
            towers,
            vocabulary,
            action_bins: self.n_action_bins,
            action_scale,
            prompt_template: prompt.template,
            reasoning: prompt.reasoning,
            completion_tokens_max,
            text: TextConfig {
                num_key_value_heads: Some(self.text_config.key_value_heads()),
                ..self.text_config
            },
            partial_reasoning: prompt.reasoning && !self.reasoning_strict,
            center_crop: options.center_crop || self.center_crop,
        })
    }

    fn towers(&self) -> Result<Vec<TowerConfig>> {
        let count = if self.use_fused_vision_backbone { 2 } else { 1 };
        ensure!(
            self.timm_model_ids.len() == count,
            "timm_model_ids: expected {count} towers, got {:?}",
            self.timm_model_ids
        );
        let described = [&self.vision_config, &self.fused_vision_config];
        let towers = self.timm_model_ids.iter().zip(described).map(|(id, described)| {
            let known = TowerConfig::of_timm(id);
            match (known, described) {
                (Some(known), None) => Ok(known),
                (None, Some(described)) => Ok(described.clone()),
                (Some(_), Some(_)) => {
                    bail!("vision_config: expected none, because {id} is a known tower")
                }
                (None, None) => bail!("timm_model_ids: expected a known tower or one described in vision_config, got {id}"),
            }
        });
        let towers: Vec<TowerConfig> = towers.collect::<Result<_>>()?;
        for tower in &towers {
            tower.check()?;
        }
        Ok(towers)
    }
}
