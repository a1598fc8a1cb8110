//! The Llama decoder: from embeddings to hidden states after the final norm.
//!
//! `prefill` computes the image and prompt of every session once and keeps their keys and values.
//! `step` adds one token to every candidate. The rows of all sessions share each product with a
//! weight.

use std::ops::Range;

use anyhow::{Result, ensure};
use candle_core::{DType, Device, Tensor};

use crate::checkpoint::config::TextConfig;
use crate::checkpoint::weights::{Part, in_order};
use crate::kernels::activation::gated_silu;
use crate::kernels::backend::{Backend, Values};
use crate::kernels::matmul;
use crate::kernels::norm::RmsNorm;
use crate::kernels::segment::{BLOCK, tail_positions};
use crate::network::attention::{Group, Prefix};
use crate::network::cache::{PrefixCache, TailCache};
use crate::network::linear::Linear;
use crate::network::rotary::{HeadShape, Rotary};
use crate::network::trace::Trace;

/// From token ids to hidden states to logits.
pub struct Decoder {
    embed_tokens: Tensor,
    layers: Vec<Layer>,
    norm: RmsNorm,
    lm_head: Linear,
    rotary: Rotary,
    shape: HeadShape,
    positions_max: usize,
    backend: Backend,
    device: Device,
}

/// One layer. One product computes queries, keys and values, another one gates and ups.
struct Layer {
    input_layernorm: RmsNorm,
    query_key_value: Linear,
    o_proj: Linear,
    post_attention_layernorm: RmsNorm,
    gate_up: Linear,
    down_proj: Linear,
    backend: Backend,
}

/// The positions of a prefill whose hidden states are returned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// The last position of each session; the last layer then skips all others.
    Last,
    All,
}

impl Decoder {
    /// Loads the weights under `language_model`.
    pub fn load(mut weights: Part<'_, '_>, config: &TextConfig) -> Result<Decoder> {
        let (hidden, vocabulary) = (config.hidden_size, config.vocab_size);
        let target = weights.target();
        let (backend, device) = (target.backend, target.device.clone());
        // Tensors are taken in the order of their names, which is the order of the digest: they are
        // then read once.
        let lm_head = weights.take_to_host("lm_head.weight", &[vocabulary, hidden])?;
        let lm_head = Linear::new(&lm_head, None, &target)?;
        let embedding = weights.take_to_host("model.embed_tokens.weight", &[vocabulary, hidden])?;
        let embed_tokens = embedding_table(embedding, backend)?.to_device(&device)?;
        let layers = in_order(config.num_hidden_layers, |index| {
            Layer::load(weights.part(&format!("model.layers.{index}")), config)
        })?;
        let norm = RmsNorm {
            weight: weights.take("model.norm.weight", &[hidden])?,
            epsilon: config.rms_norm_eps,
            backend,
        };
        let shape = config.head_shape();
        let positions_max = config.max_position_embeddings;
        Ok(Decoder {
            embed_tokens,
            layers,
            norm,
            lm_head,
            rotary: Rotary::new(shape.size, positions_max, config.rope_theta, backend, &device)?,
            shape,
            positions_max,
            backend,
            device,
        })
    }

    /// Maximum length of a sequence.
    pub fn positions_max(&self) -> usize {
        self.positions_max
    }

    /// Bytes of the matrix weights that a step reads; embeddings and norms add only a few
    /// kilobytes.
    pub fn step_bytes(&self) -> usize {
        let layer = |layer: &Layer| {
            let Layer { query_key_value, o_proj, gate_up, down_proj, .. } = layer;
            [query_key_value, o_proj, gate_up, down_proj]
                .into_iter()
                .map(Linear::bytes)
                .sum::<usize>()
        };
        self.layers.iter().map(layer).sum::<usize>() + self.lm_head.bytes()
    }

    /// Bytes of keys and values of a session: a prefix, and a tail for each candidate.
    pub fn cache_bytes(&self, prefix: usize, candidates: usize, tail: usize) -> usize {
        let positions = prefix.next_multiple_of(BLOCK) + candidates * tail_positions(tail);
        let width = match self.backend {
            Backend::Kernels => DType::F32,
            Backend::Tensors(dtype) => dtype,
        }
        .size_in_bytes();
        2 * self.layers.len() * self.shape.key_width() * width * positions
    }

    /// Token ids -> (ids, hidden)
    pub fn embed(&self, ids: &[u32]) -> Result<Tensor> {
        let ids = Tensor::new(ids, &self.device)?;
        Ok(self.embed_tokens.index_select(&ids, 0)?.to_dtype(DType::F32)?)
    }

    /// Computes whole sequences, whose embeddings are concatenated in `rows`.
    pub fn prefill(
        &self,
        rows: &Tensor,
        sessions: &[Range<usize>],
        wanted: Wanted,
        trace: &mut Trace,
    ) -> Result<(PrefixCache, Tensor)> {
        let longest = sessions.iter().map(Range::len).max().unwrap_or(0);
        ensure!(
            longest <= self.positions_max,
            "prompt: expected at most {} positions, got {longest}",
            self.positions_max
        );
        let positions: Vec<usize> = sessions.iter().flat_map(|rows| 0..rows.len()).collect();
        let mut rows = rows.clone();
        let mut prefixes = Vec::new();
        for (index, layer) in self.layers.iter().enumerate() {
            let (mut query, key, value) =
                self.rotary.split(&layer.joined(&rows)?, self.shape, &positions)?;
            let prefix = Prefix::new(&key, &value, sessions, self.shape, self.backend)?;
            let mut groups = groups_of(sessions);
            if wanted == Wanted::Last && index + 1 == self.layers.len() {
                let last: Vec<u32> = sessions.iter().map(|rows| rows.end as u32 - 1).collect();
                let last = Tensor::new(last, &self.device)?;
                (rows, query) = (rows.index_select(&last, 0)?, query.index_select(&last, 0)?);
                let one = |session| Group { session, rows: session..session + 1 };
                groups = (0..sessions.len()).map(one).collect();
            }
            let mixed = prefix.attend(&query, &groups, true)?;
            rows = layer.finish(&rows, &mixed)?;
            trace.record(|| format!("language_model.model.layers.{index}"), &rows);
            prefixes.push(prefix);
        }
        let hidden = self.norm.forward(&rows)?;
        trace.record(|| "language_model.model.norm".to_string(), &hidden);
        Ok((PrefixCache::new(prefixes, sessions), hidden))
    }

    /// Empty tails; each row continues one of `sessions`, in ascending order.
    pub fn tails(&self, sessions: Vec<usize>, capacity: usize) -> TailCache {
        TailCache::new(sessions, capacity, self.layers.len(), self.shape, self.backend)
    }

    /// Adds one token to every row of `tail`; returns (rows, hidden) after the final norm.
    pub fn step(&self, ids: &[u32], prefix: &PrefixCache, tail: &mut TailCache) -> Result<Tensor> {
        let positions = tail.positions(prefix);
        ensure!(
            positions.iter().all(|&position| position < self.positions_max),
            "candidate: expected at most {} positions, got more",
            self.positions_max
        );
        let groups = tail.groups();
        let mut rows = self.embed(ids)?;
        for (index, layer) in self.layers.iter().enumerate() {
            let (query, key, value) =
                self.rotary.split(&layer.joined(&rows)?, self.shape, &positions)?;
            let own = &mut tail.layers[index];
            own.push(&key, &value)?;
            let mixed = own.attend(&query, &prefix.layers[index], &groups)?;
            rows = layer.finish(&rows, &mixed)?;
        }
        tail.advance();
        Ok(self.norm.forward(&rows)?)
    }

    /// (rows, hidden) after the final norm -> (rows, vocabulary with padding)
    pub fn logits(&self, hidden: &Tensor) -> Result<Tensor> {
        Ok(self.lm_head.forward(hidden)?)
    }
}

/// The table in 16 bits where these are exact, or in the type of a device's matrices.
fn embedding_table(table: Tensor, backend: Backend) -> Result<Tensor> {
    let dtype = match backend {
        Backend::Kernels if matmul::is_exact_in_half(&Values::of(&table)?) => DType::BF16,
        Backend::Kernels => DType::F32,
        Backend::Tensors(dtype) => dtype,
    };
    Ok(table.to_dtype(dtype)?)
}

fn groups_of(sessions: &[Range<usize>]) -> Vec<Group> {
    let sessions = sessions.iter().cloned().enumerate();
    sessions.map(|(session, rows)| Group { session, rows }).collect()
}

impl Layer {
    fn load(mut weights: Part<'_, '_>, config: &TextConfig) -> Result<Layer> {
        let (hidden, width) = (config.hidden_size, config.intermediate_size);
        let shape = config.head_shape();
        let (query_width, key_width) = (shape.query_width(), shape.key_width());
        let target = weights.target();
        let backend = target.backend;
        let norm = |weights: &mut Part<'_, '_>, name: &str| -> Result<RmsNorm> {
            let weight = weights.take(&format!("{name}.weight"), &[hidden])?;
            Ok(RmsNorm { weight, epsilon: config.rms_norm_eps, backend })
        };
        let weight = |weights: &mut Part<'_, '_>, name: &str, outputs: usize, inputs: usize| {
            weights.take_to_host(&format!("{name}.weight"), &[outputs, inputs])
        };
        let linear = |weight: &Tensor| Linear::new(weight, None, &target);
        // In the order of names.
        let input_layernorm = norm(&mut weights, "input_layernorm")?;
        let down_proj = linear(&weight(&mut weights, "mlp.down_proj", hidden, width)?)?;
        let gate = weight(&mut weights, "mlp.gate_proj", width, hidden)?;
        let up = weight(&mut weights, "mlp.up_proj", width, hidden)?;
        let gate_up = linear(&Tensor::cat(&[gate, up], 0)?)?;
        let post_attention_layernorm = norm(&mut weights, "post_attention_layernorm")?;
        let key = weight(&mut weights, "self_attn.k_proj", key_width, hidden)?;
        let o_proj = linear(&weight(&mut weights, "self_attn.o_proj", hidden, query_width)?)?;
        let query = weight(&mut weights, "self_attn.q_proj", query_width, hidden)?;
        let value = weight(&mut weights, "self_attn.v_proj", key_width, hidden)?;
        let query_key_value = linear(&Tensor::cat(&[query, key, value], 0)?)?;
        Ok(Layer {
            input_layernorm,
            query_key_value,
            o_proj,
            post_attention_layernorm,
            gate_up,
            down_proj,
            backend,
        })
    }

    /// (rows, hidden) -> (rows, queries, keys and values)
    fn joined(&self, rows: &Tensor) -> candle_core::Result<Tensor> {
        self.query_key_value.forward(&self.input_layernorm.forward(rows)?)
    }

    /// The part of the layer after attention.
    fn finish(&self, rows: &Tensor, mixed: &Tensor) -> candle_core::Result<Tensor> {
        let rows = self.o_proj.forward_onto(rows, mixed)?;
        let gates = self.gate_up.forward(&self.post_attention_layernorm.forward(&rows)?)?;
        self.down_proj.forward_onto(&rows, &gated_silu(&gates, self.backend)?)
    }
}
