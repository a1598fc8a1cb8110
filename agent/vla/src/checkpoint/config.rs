//! A checkpoint's `config.json` with OpenVLA's fields. Unknown layouts are refused.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use serde::{Deserialize, Serialize};

use crate::network::rotary::HeadShape;

/// Dimensions of an action: three of translation, three of rotation, the gripper.
pub const ACTION_LENGTH: usize = 7;
/// Maximum tokens of a completion if the checkpoint states no limit; this is ECoT's own limit.
const REASONING_TOKENS_MAX: usize = 1024;

const OPENVLA_PROMPT: &str = "In: What action should the robot take to {instruction}?\nOut:";
const VICUNA_PROMPT: &str = "A chat between a curious user and an artificial intelligence \
    assistant. The assistant gives helpful, detailed, and polite answers to the user's questions. \
    USER: What action should the robot take to {instruction}? ASSISTANT: TASK:";

/// The architecture, inputs and outputs of the network; its JSON is part of the checkpoint's
/// identity.
#[derive(Debug, Clone, Serialize)]
pub struct Config {
    /// With two towers, the first one is DINO-like.
    pub towers: Vec<TowerConfig>,
    pub image_size: usize,
    pub text: TextConfig,
    /// Size of the tokenizer's vocabulary; the embedding has padding rows above it.
    pub vocabulary: usize,
    pub action_bins: usize,
    pub action_scale: ActionScale,
    pub prompt_template: String,
    /// Whether completions contain a chain of thought before the action.
    pub reasoning: bool,
    pub completion_tokens_max: usize,
}

/// One vision transformer, with timm's field names.
#[derive(Debug, Clone, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct TowerConfig {
    pub image_size: usize,
    pub patch_size: usize,
    pub embed_dim: usize,
    pub depth: usize,
    pub num_heads: usize,
    pub mlp_ratio: f64,
    pub class_token: bool,
    pub registers: usize,
    pub layer_scale: bool,
}

/// The Llama decoder. Fields missing in `text_config` have Hugging Face's defaults.
#[derive(Debug, Clone, Deserialize, Serialize)]
#[serde(default)]
pub struct TextConfig {
    pub model_type: String,
    pub hidden_act: String,
    pub hidden_size: usize,
    pub intermediate_size: usize,
    pub num_hidden_layers: usize,
    pub num_attention_heads: usize,
    pub num_key_value_heads: Option<usize>,
    pub vocab_size: usize,
    pub rms_norm_eps: f64,
    pub rope_theta: f32,
    pub rope_scaling: Option<serde_json::Value>,
    pub max_position_embeddings: usize,
    pub tie_word_embeddings: bool,
    pub attention_bias: bool,
    pub bos_token_id: u32,
    pub eos_token_id: u32,
}

impl Default for TextConfig {
    fn default() -> TextConfig {
        TextConfig {
            model_type: "llama".to_string(),
            hidden_act: "silu".to_string(),
            hidden_size: 4096,
            intermediate_size: 11008,
            num_hidden_layers: 32,
            num_attention_heads: 32,
            num_key_value_heads: None,
            vocab_size: 32000,
            rms_norm_eps: 1e-6,
            rope_theta: 10000.0,
            rope_scaling: None,
            max_position_embeddings: 2048,
            tie_word_embeddings: false,
            attention_bias: false,
            bos_token_id: 1,
            eos_token_id: 2,
        }
    }
}

/// The scale from normalised to physical actions: 1st and 99th percentile of the training data.
#[derive(Debug, Clone, Deserialize, Serialize)]
pub struct ActionScale {
    pub q01: [f64; ACTION_LENGTH],
    pub q99: [f64; ACTION_LENGTH],
    /// False for a dimension that is not normalised.
    pub mask: [bool; ACTION_LENGTH],
}

/// The fields of the file that determine the layout. Fields that matter only for training are
/// ignored.
#[derive(Deserialize)]
struct File {
    model_type: String,
    #[serde(default)]
    llm_backbone_id: String,
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
    norm_stats: BTreeMap<String, DatasetStatistics>,
    unnorm_key: Option<String>,
    prompt_template: Option<String>,
    #[serde(default)]
    reasoning: bool,
    max_new_tokens: Option<usize>,
}

#[derive(Deserialize)]
struct DatasetStatistics {
    action: ActionScale,
}

impl Config {
    /// Loads and checks `config.json`.
    pub fn load(path: &Path) -> Result<Config> {
        let name = path.display();
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {name}"))?;
        Config::parse(&text).with_context(|| format!("cannot use {name}"))
    }

    fn parse(text: &str) -> Result<Config> {
        let file: File = serde_json::from_str(text)?;
        ensure!(
            file.model_type == "openvla",
            "model_type: expected openvla, got {}",
            file.model_type
        );
        ensure!(
            file.timm_override_act_layers.iter().all(Option::is_none),
            "timm_override_act_layers: expected null for every tower, got {:?}",
            file.timm_override_act_layers
        );
        ensure!(
            ["resize-naive", "letterbox"].contains(&file.image_resize_strategy.as_str()),
            "image_resize_strategy: expected resize-naive or letterbox, got {}",
            file.image_resize_strategy
        );
        let towers = file.towers()?;
        let image_size = towers[0].image_size;
        ensure!(
            file.image_sizes.iter().all(|&size| size == image_size)
                && towers.iter().all(|tower| tower.image_size == image_size),
            "image_sizes: expected {image_size} for every tower, got {:?}",
            file.image_sizes
        );
        file.text_config.check()?;
        let vocabulary = file.text_config.vocab_size.saturating_sub(file.pad_to_multiple_of);
        ensure!(
            file.n_action_bins == 256 && vocabulary > 256,
            "n_action_bins: expected 256 and a vocabulary of more than 256 tokens, got {} and {vocabulary}",
            file.n_action_bins
        );
        let limit = if file.reasoning { REASONING_TOKENS_MAX } else { ACTION_LENGTH + 1 };
        Ok(Config {
            image_size,
            towers,
            vocabulary,
            action_bins: file.n_action_bins,
            action_scale: file.action_scale()?,
            prompt_template: file.prompt_template()?,
            reasoning: file.reasoning,
            completion_tokens_max: file.max_new_tokens.unwrap_or(limit),
            text: TextConfig {
                num_key_value_heads: Some(file.text_config.key_value_heads()),
                ..file.text_config
            },
        })
    }
}

impl File {
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

    fn action_scale(&self) -> Result<ActionScale> {
        let datasets: Vec<&String> = self.norm_stats.keys().collect();
        let key = match (&self.unnorm_key, datasets.as_slice()) {
            (Some(key), _) => key,
            (None, [only]) => *only,
            (None, _) => bail!("unnorm_key: expected one of {datasets:?} in config.json, got none"),
        };
        let statistics = self.norm_stats.get(key);
        let statistics = statistics
            .with_context(|| format!("unnorm_key: expected one of {datasets:?}, got {key:?}"))?;
        let scale = statistics.action.clone();
        let finite = scale.q01.iter().chain(&scale.q99).all(|number| number.is_finite());
        ensure!(finite, "norm_stats of {key}: expected finite q01 and q99, got {scale:?}");
        Ok(scale)
    }

    fn prompt_template(&self) -> Result<String> {
        let template = match (&self.prompt_template, self.llm_backbone_id.as_str()) {
            (Some(template), _) => template.as_str(),
            (None, "llama2-7b-pure") => OPENVLA_PROMPT,
            (None, "vicuna-v15-7b") => VICUNA_PROMPT,
            (None, other) => {
                bail!("prompt_template: expected one, because llm_backbone_id {other:?} is unknown")
            }
        };
        ensure!(
            template.matches("{instruction}").count() == 1,
            "prompt_template: expected {{instruction}} once, got {template:?}"
        );
        Ok(template.to_string())
    }
}

impl TowerConfig {
    /// The vision towers of OpenVLA-7B by their timm names.
    fn of_timm(id: &str) -> Option<TowerConfig> {
        let tower = TowerConfig {
            image_size: 224,
            patch_size: 14,
            embed_dim: 1024,
            depth: 24,
            num_heads: 16,
            mlp_ratio: 4.0,
            class_token: true,
            registers: 4,
            layer_scale: true,
        };
        match id {
            "vit_large_patch14_reg4_dinov2.lvd142m" => Some(tower),
            "vit_so400m_patch14_siglip_224" => Some(TowerConfig {
                embed_dim: 1152,
                depth: 27,
                mlp_ratio: 4304.0 / 1152.0,
                class_token: false,
                registers: 0,
                layer_scale: false,
                ..tower
            }),
            _ => None,
        }
    }

    fn check(&self) -> Result<()> {
        ensure!(
            self.patch_size > 0
                && self.image_size > 0
                && self.image_size.is_multiple_of(self.patch_size),
            "patch_size: expected a divisor of image size {}, got {}",
            self.image_size,
            self.patch_size
        );
        ensure!(
            self.num_heads > 0
                && self.embed_dim > 0
                && self.embed_dim.is_multiple_of(self.num_heads),
            "num_heads: expected a divisor of embed_dim {}, got {}",
            self.embed_dim,
            self.num_heads
        );
        ensure!(self.depth >= 2, "depth: expected at least 2 blocks, got {}", self.depth);
        Ok(())
    }

    /// Patches along one side.
    pub fn side(&self) -> usize {
        self.image_size / self.patch_size
    }

    /// Number of class and register tokens before the patches.
    pub fn prefix_tokens(&self) -> usize {
        usize::from(self.class_token) + self.registers
    }

    /// Width of the hidden layer of each MLP.
    pub fn mlp_width(&self) -> usize {
        (self.embed_dim as f64 * self.mlp_ratio).round() as usize
    }

    /// Attention heads of every block.
    pub fn head_shape(&self) -> HeadShape {
        let size = self.embed_dim / self.num_heads;
        HeadShape { heads: self.num_heads, key_value_heads: self.num_heads, size }
    }
}

impl TextConfig {
    fn check(&self) -> Result<()> {
        ensure!(self.model_type == "llama", "model_type: expected llama, got {}", self.model_type);
        ensure!(self.hidden_act == "silu", "hidden_act: expected silu, got {}", self.hidden_act);
        if let Some(scaling) = &self.rope_scaling {
            bail!("rope_scaling: expected none, got {scaling}");
        }
        ensure!(!self.tie_word_embeddings, "tie_word_embeddings: expected false, got true");
        ensure!(!self.attention_bias, "attention_bias: expected false, got true");
        let (heads, key_value_heads) = (self.num_attention_heads, self.key_value_heads());
        ensure!(
            heads > 0 && self.hidden_size.is_multiple_of(2 * heads),
            "num_attention_heads: expected an even head size for hidden_size {}, got {heads} heads",
            self.hidden_size
        );
        ensure!(
            key_value_heads > 0 && heads.is_multiple_of(key_value_heads),
            "num_key_value_heads: expected a divisor of {heads}, got {key_value_heads}"
        );
        ensure!(self.num_hidden_layers > 0, "num_hidden_layers: expected at least 1, got 0");
        Ok(())
    }

    fn key_value_heads(&self) -> usize {
        self.num_key_value_heads.unwrap_or(self.num_attention_heads)
    }

    /// Attention heads of every layer.
    pub fn head_shape(&self) -> HeadShape {
        HeadShape {
            heads: self.num_attention_heads,
            key_value_heads: self.key_value_heads(),
            size: self.hidden_size / self.num_attention_heads,
        }
    }
}
