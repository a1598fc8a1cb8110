//! The projector from patch features to the decoder's width: two layers, or three for fused towers.

use anyhow::Result;
use candle_core::Tensor;

use crate::checkpoint::weights::Part;
use crate::kernels::activation::gelu;
use crate::kernels::backend::Backend;
use crate::network::linear::Linear;
use crate::network::trace::Trace;

/// Linear layers with GELU between them.
pub struct Projector {
    layers: Vec<Linear>,
    backend: Backend,
}

impl Projector {
    /// Loads the layers. With fused towers the first layer is four times as wide as the features.
    pub fn load(
        mut weights: Part<'_, '_>,
        vision_width: usize,
        hidden: usize,
        fused: bool,
    ) -> Result<Projector> {
        let widths = if fused {
            vec![vision_width, 4 * vision_width, hidden, hidden]
        } else {
            vec![vision_width, hidden, hidden]
        };
        let target = weights.target().exact();
        let mut layers = Vec::new();
        for (index, pair) in widths.windows(2).enumerate() {
            let mut part = weights.part(&format!("fc{}", index + 1));
            let bias = part.take("bias", &[pair[1]])?;
            let weight = part.take_to_host("weight", &[pair[1], pair[0]])?;
            layers.push(Linear::new(&weight, Some(bias), &target)?);
        }
        Ok(Projector { layers, backend: target.backend })
    }

    /// (patches, vision width) -> (patches, hidden)
    pub fn forward(&self, features: &Tensor, trace: &mut Trace) -> Result<Tensor> {
        let mut rows = features.clone();
        for (index, layer) in self.layers.iter().enumerate() {
            if index > 0 {
                rows = gelu(&rows, self.backend)?;
            }
            rows = layer.forward(&rows)?;
        }
        trace.record(|| "projector".to_string(), &rows);
        Ok(rows)
    }
}
