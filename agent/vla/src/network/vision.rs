//! The vision backbone: one timm-style vision transformer, or two whose features are concatenated.
//!
//! Features are the output of the second-to-last block, without final norm and prefix tokens. The
//! rows of all images are concatenated: (images x tokens, width).

use std::ops::Range;

use anyhow::Result;
use candle_core::{Device, Tensor};

use crate::checkpoint::config::TowerConfig;
use crate::checkpoint::weights::{Part, Target, in_order};
use crate::kernels::activation::gelu;
use crate::kernels::backend::Backend;
use crate::kernels::norm::LayerNorm;
use crate::network::attention::{Group, Prefix};
use crate::network::linear::Linear;
use crate::network::pixels::{DINO, Normalisation, SIGLIP, patch_rows};
use crate::network::rotary::HeadShape;
use crate::network::trace::Trace;
use protocol::message::Image;

/// timm's value for both towers of OpenVLA; PyTorch's default is 1e-5.
const LAYER_NORM_EPSILON: f64 = 1e-6;
const TOWER_NAMES: [&str; 2] = ["featurizer", "fused_featurizer"];

/// All vision towers of a checkpoint.
pub struct VisionBackbone {
    towers: Vec<Tower>,
}

struct Tower {
    config: TowerConfig,
    name: &'static str,
    normalisation: Normalisation,
    patch_embed: Linear,
    /// (patches, width)
    pos_embed: Tensor,
    /// (prefix tokens, width), if there are any.
    prefix: Option<Tensor>,
    blocks: Vec<Block>,
    device: Device,
}

struct Block {
    norm1: LayerNorm,
    query: Linear,
    key: Linear,
    value: Linear,
    proj: Linear,
    ls1: Option<Tensor>,
    norm2: LayerNorm,
    fc1: Linear,
    fc2: Linear,
    ls2: Option<Tensor>,
    shape: HeadShape,
    backend: Backend,
}

impl VisionBackbone {
    /// Loads the towers' weights; with two towers, the first one is DINO-like.
    pub fn load(mut weights: Part<'_, '_>, configs: &[TowerConfig]) -> Result<VisionBackbone> {
        let mut towers = Vec::new();
        for (index, config) in configs.iter().enumerate() {
            let name = TOWER_NAMES[index];
            let normalisation = normalisation(configs, index);
            towers.push(Tower::load(weights.part(name), config, name, normalisation)?);
        }
        Ok(VisionBackbone { towers })
    }

    /// Names of the towers with their numbers of used blocks.
    pub fn blocks_used(configs: &[TowerConfig]) -> Vec<(String, usize)> {
        let named = configs.iter().zip(TOWER_NAMES);
        named.map(|(config, name)| (format!("vision_backbone.{name}"), config.depth - 1)).collect()
    }

    /// Images of the model's size -> (images x patches, width of all towers).
    pub fn forward(&self, images: &[&Image], trace: &mut Trace) -> Result<Tensor> {
        let features = self.towers.iter().map(|tower| tower.forward(images, trace));
        let features = features.collect::<Result<Vec<_>>>()?;
        match features.as_slice() {
            [only] => Ok(only.clone()),
            several => Ok(Tensor::cat(several, 1)?),
        }
    }
}

/// The first tower of a fused pair and a single DINOv2 tower have ImageNet's values.
fn normalisation(configs: &[TowerConfig], index: usize) -> Normalisation {
    let is_fused_first = configs.len() == 2 && index == 0;
    if is_fused_first || configs[index].is_dino() { DINO } else { SIGLIP }
}

impl Tower {
    fn load(
        mut weights: Part<'_, '_>,
        config: &TowerConfig,
        name: &'static str,
        normalisation: Normalisation,
    ) -> Result<Tower> {
        let (width, patch) = (config.embed_dim, config.patch_size);
        let patches = config.side() * config.side();
        let target = weights.target().exact();
        // In the order of names, as in the decoder.
        let blocks = in_order(config.depth - 1, |index| {
            Block::load(weights.part(&format!("blocks.{index}")), config)
        })?;
        let mut prefix = Vec::new();
        if config.class_token {
            prefix.push(weights.take("cls_token", &[1, 1, width])?.squeeze(0)?);
        }
        let bias = weights.take("patch_embed.proj.bias", &[width])?;
        let kernel = weights.take_to_host("patch_embed.proj.weight", &[width, 3, patch, patch])?;
        let patch_embed = Linear::new(&kernel.flatten_from(1)?, Some(bias), &target)?;
        let pos_embed = weights.take("pos_embed", &[1, patches, width])?.squeeze(0)?;
        if config.registers > 0 {
            prefix.push(weights.take("reg_token", &[1, config.registers, width])?.squeeze(0)?);
        }
        let prefix = if prefix.is_empty() { None } else { Some(Tensor::cat(&prefix, 0)?) };
        let (config, device) = (config.clone(), target.device);
        Ok(Tower { config, name, normalisation, patch_embed, pos_embed, prefix, blocks, device })
    }

    fn forward(&self, images: &[&Image], trace: &mut Trace) -> Result<Tensor> {
        let (side, patch) = (self.config.side(), self.config.patch_size);
        let (patches, width) = (side * side, self.config.embed_dim);
        let inputs = patch_rows(images, side, patch, &self.normalisation);
        let shape = (images.len() * patches, 3 * patch * patch);
        let rows = self.patch_embed.forward(&Tensor::from_vec(inputs, shape, &self.device)?)?;
        trace.record(|| format!("vision_backbone.{}.patch_embed", self.name), &rows);
        // (images x patches, width) -> (images, patches, width)
        let rows = rows.reshape((images.len(), patches, width))?.broadcast_add(&self.pos_embed)?;
        let rows = match &self.prefix {
            Some(prefix) => {
                let shape = (images.len(), prefix.dim(0)?, width);
                Tensor::cat(&[prefix.unsqueeze(0)?.expand(shape)?, rows], 1)?
            }
            None => rows,
        };
        let tokens = rows.dim(1)?;
        // (images, tokens, width) -> (images x tokens, width)
        let mut rows = rows.contiguous()?.flatten_to(1)?;
        for (index, block) in self.blocks.iter().enumerate() {
            rows = block.forward(&rows, tokens)?;
            trace.record(|| format!("vision_backbone.{}.blocks.{index}", self.name), &rows);
        }
        // (images x tokens, width) -> (images, patches, width) -> (images x patches, width)
        let rows = rows.reshape((images.len(), tokens, width))?;
        let rows = rows.narrow(1, self.config.prefix_tokens(), patches)?;
        let rows = rows.contiguous()?.flatten_to(1)?;
        trace.record(|| format!("vision_backbone.{}", self.name), &rows);
        Ok(rows)
    }
}

impl Block {
    fn load(mut weights: Part<'_, '_>, config: &TowerConfig) -> Result<Block> {
        let (width, hidden) = (config.embed_dim, config.mlp_width());
        let target = weights.target().exact();
        let backend = target.backend;
        // In the order of names, as in the decoder.
        let proj = linear(&mut weights, "attn.proj", width, width, &target)?;
        let joined_bias = weights.take("attn.qkv.bias", &[3 * width])?;
        let joined = weights.take_to_host("attn.qkv.weight", &[3 * width, width])?;
        let third = |index: usize| {
            let bias = joined_bias.narrow(0, index * width, width)?.contiguous()?;
            Linear::new(&joined.narrow(0, index * width, width)?, Some(bias), &target)
        };
        let (query, key, value) = (third(0)?, third(1)?, third(2)?);
        let mut layer_scale = |name: &str| -> Result<Option<Tensor>> {
            let name = format!("{name}.scale_factor");
            config.layer_scale.then(|| weights.take(&name, &[width])).transpose()
        };
        let (ls1, ls2) = (layer_scale("ls1")?, layer_scale("ls2")?);
        let fc1 = linear(&mut weights, "mlp.fc1", hidden, width, &target)?;
        let fc2 = linear(&mut weights, "mlp.fc2", width, hidden, &target)?;
        let mut norm = |name: &str| -> Result<LayerNorm> {
            let bias = weights.take(&format!("{name}.bias"), &[width])?;
            let weight = weights.take(&format!("{name}.weight"), &[width])?;
            Ok(LayerNorm { weight, bias, epsilon: LAYER_NORM_EPSILON, backend })
        };
        let (norm1, norm2) = (norm("norm1")?, norm("norm2")?);
        let shape = config.head_shape();
        Ok(Block { norm1, query, key, value, proj, ls1, norm2, fc1, fc2, ls2, shape, backend })
    }

    /// (images x tokens, width) -> the same shape; the tokens of an image attend only to each
    /// other.
    fn forward(&self, rows: &Tensor, tokens: usize) -> Result<Tensor> {
        let images: Vec<Range<usize>> =
            (0..rows.dim(0)? / tokens).map(|image| image * tokens..(image + 1) * tokens).collect();
        let input = self.norm1.forward(rows)?;
        let (key, value) = (self.key.forward(&input)?, self.value.forward(&input)?);
        let keys = Prefix::new(&key, &value, &images, self.shape, self.backend)?;
        let groups: Vec<Group> =
            images.into_iter().enumerate().map(|(session, rows)| Group { session, rows }).collect();
        let mixed = keys.attend(&self.query.forward(&input)?, &groups, false)?;
        let rows = onto(rows, &self.proj, &mixed, self.ls1.as_ref())?;
        let hidden = self.fc1.forward(&self.norm2.forward(&rows)?)?;
        onto(&rows, &self.fc2, &gelu(&hidden, self.backend)?, self.ls2.as_ref())
    }
}

fn linear(
    weights: &mut Part<'_, '_>,
    name: &str,
    outputs: usize,
    inputs: usize,
    target: &Target,
) -> Result<Linear> {
    let bias = weights.take(&format!("{name}.bias"), &[outputs])?;
    let weight = weights.take_to_host(&format!("{name}.weight"), &[outputs, inputs])?;
    Ok(Linear::new(&weight, Some(bias), target)?)
}

/// rows + layer scale x linear(input).
fn onto(rows: &Tensor, linear: &Linear, input: &Tensor, scale: Option<&Tensor>) -> Result<Tensor> {
    Ok(match scale {
        Some(scale) => (rows + linear.forward(input)?.broadcast_mul(scale)?)?,
        None => linear.forward_onto(rows, input)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dinov2_tower_has_imagenets_values_alone_and_in_a_pair() {
        let siglip = TowerConfig {
            image_size: 224,
            patch_size: 14,
            embed_dim: 1152,
            depth: 27,
            num_heads: 16,
            mlp_ratio: 4.0,
            class_token: false,
            registers: 0,
            layer_scale: false,
        };
        let dino =
            TowerConfig { class_token: true, registers: 4, layer_scale: true, ..siglip.clone() };
        let means = |configs: &[TowerConfig]| -> Vec<f32> {
            (0..configs.len()).map(|index| normalisation(configs, index).mean[0]).collect()
        };
        assert_eq!(means(std::slice::from_ref(&dino)), [0.485]);
        assert_eq!(means(std::slice::from_ref(&siglip)), [0.5]);
        assert_eq!(means(&[dino, siglip.clone()]), [0.485, 0.5]);
        assert_eq!(means(&[siglip.clone(), siglip]), [0.485, 0.5]);
    }
}
