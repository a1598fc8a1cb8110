//! A checkpoint's configuration: `config.json` with OpenVLA's fields, and what was chosen of it.
//! Unknown layouts are refused.

mod family;
mod file;
mod prompt;
mod statistics;

use anyhow::{Result, bail, ensure};
use serde::{Deserialize, Serialize};

use crate::network::rotary::HeadShape;

pub use statistics::ActionScale;

/// Dimensions of an action: three of translation, three of rotation, the gripper.
pub const ACTION_LENGTH: usize = 7;

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
    // Omitted from the JSON where false, so that older checkpoints keep their digests.
    /// Whether a chain of thought is read as far as possible, instead of refused with its action.
    #[serde(skip_serializing_if = "is_false")]
    pub partial_reasoning: bool,
    /// Whether images are cropped to the central 90 % of their area and enlarged again.
    #[serde(skip_serializing_if = "is_false")]
    pub center_crop: bool,
}

fn is_false(value: &bool) -> bool {
    !value
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

    /// Whether this is a DINOv2 tower with registers, whose images are normalised with ImageNet's
    /// values.
    pub fn is_dino(&self) -> bool {
        self.class_token && self.registers > 0 && self.layer_scale
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
