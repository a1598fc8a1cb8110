//! The whole network: from image and prompt ids to hidden states and logits.

use std::ops::Range;

use anyhow::Result;
use candle_core::Tensor;
use protocol::message::Image;
use rayon::prelude::*;

use crate::checkpoint::config::Config;
use crate::checkpoint::weights::{Rest, Weights};
use crate::network::cache::PrefixCache;
use crate::network::decoder::{Decoder, Wanted};
use crate::network::projector::Projector;
use crate::network::trace::Trace;
use crate::network::vision::VisionBackbone;

/// Sessions per prefill task: few enough for a layer's rows to stay in the CPU caches.
const TASK_SESSIONS: usize = 2;

/// Vision towers, projector and decoder of one checkpoint.
pub struct Network {
    vision_backbone: VisionBackbone,
    projector: Projector,
    pub decoder: Decoder,
}

/// The input of a session: the first id, the image, the other ids.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    pub image: &'a Image,
    pub ids: &'a [u32],
}

impl Network {
    /// Makes the layers of their tensors.
    pub fn load(mut weights: Weights<'_>, config: &Config) -> Result<(Network, Rest)> {
        let width = config.towers.iter().map(|tower| tower.embed_dim).sum();
        let (hidden, fused) = (config.text.hidden_size, config.towers.len() == 2);
        // In the order of names, as within each of them.
        let decoder = Decoder::load(weights.part("language_model"), &config.text)?;
        let projector = Projector::load(weights.part("projector"), width, hidden, fused)?;
        let vision_backbone =
            VisionBackbone::load(weights.part("vision_backbone"), &config.towers)?;
        let rest = weights.finish()?;
        Ok((Network { vision_backbone, projector, decoder }, rest))
    }

    /// Computes images and prompts of all sessions in parallel; returns the last hidden states
    /// after the final norm.
    pub fn prefill_all(&self, contexts: &[Context<'_>]) -> Result<(PrefixCache, Tensor)> {
        let part = |contexts| self.prefill(contexts, Wanted::Last, &mut Trace::off());
        let parts = contexts.par_chunks(TASK_SESSIONS).map(part).collect::<Result<Vec<_>>>()?;
        let (caches, hidden): (Vec<PrefixCache>, Vec<Tensor>) = parts.into_iter().unzip();
        Ok((PrefixCache::join(caches), Tensor::cat(&hidden, 0)?))
    }

    /// Computes images and prompts in one batch; returns hidden states after the final norm at the
    /// wanted positions.
    pub fn prefill(
        &self,
        contexts: &[Context<'_>],
        wanted: Wanted,
        trace: &mut Trace,
    ) -> Result<(PrefixCache, Tensor)> {
        let images: Vec<&Image> = contexts.iter().map(|context| context.image).collect();
        let features = self.vision_backbone.forward(&images, trace)?;
        let patches = self.projector.forward(&features, trace)?;
        let count = patches.dim(0)? / contexts.len();
        let mut parts = Vec::with_capacity(3 * contexts.len());
        let mut sessions: Vec<Range<usize>> = Vec::with_capacity(contexts.len());
        for (index, context) in contexts.iter().enumerate() {
            let (first, others) = context.ids.split_at(1);
            parts.push(self.decoder.embed(first)?);
            parts.push(patches.narrow(0, index * count, count)?);
            parts.push(self.decoder.embed(others)?);
            let start = sessions.last().map_or(0, |rows| rows.end);
            sessions.push(start..start + context.ids.len() + count);
        }
        let rows = Tensor::cat(&parts, 0)?;
        trace.record(|| "embeddings".to_string(), &rows);
        self.decoder.prefill(&rows, &sessions, wanted, trace)
    }
}
