//! Row-wise normalisation: layer norm for the vision towers, RMS norm for the decoder.

use candle_core::{D, Result, Tensor};
use rayon::prelude::*;

use crate::kernels::backend::{Backend, Values, vectorised};

/// Number of partial sums per row, as many as a vector register holds. They are added in a fixed
/// order.
const LANES: usize = 8;
/// Rows per task; a single row costs less than starting a task.
const TASK_ROWS: usize = 32;

/// (x - mean) / sqrt(variance + epsilon) x weight + bias, over each row.
pub struct LayerNorm {
    pub weight: Tensor,
    pub bias: Tensor,
    pub epsilon: f64,
    pub backend: Backend,
}

impl LayerNorm {
    /// (rows, width) -> (rows, width)
    pub fn forward(&self, rows: &Tensor) -> Result<Tensor> {
        match self.backend {
            Backend::Kernels => {
                let (weight, bias) = (Values::of(&self.weight)?, Values::of(&self.bias)?);
                let (weight, bias): (&[f32], &[f32]) = (&weight, &bias);
                let epsilon = self.epsilon as f32;
                map_rows(rows, |row, output| layer_norm_row(row, weight, bias, epsilon, output))
            }
            Backend::Tensors(_) => {
                let centred = rows.broadcast_sub(&rows.mean_keepdim(D::Minus1)?)?;
                let variance = centred.sqr()?.mean_keepdim(D::Minus1)?;
                let scaled = centred.broadcast_div(&(variance + self.epsilon)?.sqrt()?)?;
                scaled.broadcast_mul(&self.weight)?.broadcast_add(&self.bias)
            }
        }
    }
}

/// x / sqrt(mean of squares + epsilon) x weight, over each row.
pub struct RmsNorm {
    pub weight: Tensor,
    pub epsilon: f64,
    pub backend: Backend,
}

impl RmsNorm {
    /// (rows, width) -> (rows, width)
    pub fn forward(&self, rows: &Tensor) -> Result<Tensor> {
        match self.backend {
            Backend::Kernels => {
                let weight = Values::of(&self.weight)?;
                let weight: &[f32] = &weight;
                let epsilon = self.epsilon as f32;
                map_rows(rows, |row, output| rms_norm_row(row, weight, epsilon, output))
            }
            Backend::Tensors(_) => {
                let square = rows.sqr()?.mean_keepdim(D::Minus1)?;
                let scaled = rows.broadcast_div(&(square + self.epsilon)?.sqrt()?)?;
                scaled.broadcast_mul(&self.weight)
            }
        }
    }
}

fn map_rows(rows: &Tensor, body: impl Fn(&[f32], &mut [f32]) + Sync) -> Result<Tensor> {
    let (count, width) = rows.dims2()?;
    let input = Values::of(rows)?;
    let input: &[f32] = &input;
    let mut output = vec![0.0f32; count * width];
    let task = |(input, output): (&[f32], &mut [f32])| {
        for (row, output) in input.chunks_exact(width).zip(output.chunks_exact_mut(width)) {
            body(row, output);
        }
    };
    let length = TASK_ROWS * width;
    input.par_chunks(length).zip(output.par_chunks_mut(length)).for_each(task);
    Tensor::from_vec(output, (count, width), rows.device())
}

vectorised! {
    fn rms_norm_row(row: &[f32], weight: &[f32], epsilon: f32, output: &mut [f32]) = rms_norm_body;
}

#[inline(always)]
fn rms_norm_body(row: &[f32], weight: &[f32], epsilon: f32, output: &mut [f32]) {
    let scale = 1.0 / (sum_of_squares(row, 0.0) / row.len() as f32 + epsilon).sqrt();
    for ((output, value), weight) in output.iter_mut().zip(row).zip(weight) {
        *output = value * scale * weight;
    }
}

vectorised! {
    fn layer_norm_row(
        row: &[f32],
        weight: &[f32],
        bias: &[f32],
        epsilon: f32,
        output: &mut [f32],
    ) = layer_norm_body;
}

#[inline(always)]
fn layer_norm_body(row: &[f32], weight: &[f32], bias: &[f32], epsilon: f32, output: &mut [f32]) {
    let mean = sum(row) / row.len() as f32;
    let scale = 1.0 / (sum_of_squares(row, mean) / row.len() as f32 + epsilon).sqrt();
    for (((output, value), weight), bias) in output.iter_mut().zip(row).zip(weight).zip(bias) {
        *output = ((value - mean) * scale).mul_add(*weight, *bias);
    }
}

#[inline(always)]
fn sum(row: &[f32]) -> f32 {
    let mut lanes = [0.0f32; LANES];
    let chunks = row.chunks_exact(LANES);
    let rest: f32 = chunks.remainder().iter().sum();
    for chunk in chunks {
        for lane in 0..LANES {
            lanes[lane] += chunk[lane];
        }
    }
    lanes.iter().sum::<f32>() + rest
}

#[inline(always)]
fn sum_of_squares(row: &[f32], mean: f32) -> f32 {
    let mut lanes = [0.0f32; LANES];
    let chunks = row.chunks_exact(LANES);
    let mut rest = 0.0f32;
    for value in chunks.remainder() {
        rest = (value - mean).mul_add(value - mean, rest);
    }
    for chunk in chunks {
        for lane in 0..LANES {
            let centred = chunk[lane] - mean;
            lanes[lane] = centred.mul_add(centred, lanes[lane]);
        }
    }
    lanes.iter().sum::<f32>() + rest
}
