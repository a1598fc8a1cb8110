//! Rotary position embeddings, half-split: each element of a head's first half is paired with one
//! of its second half.

use candle_core::{Device, Result, Tensor};
use rayon::prelude::*;

use crate::kernels::backend::{Backend, Values, vectorised};

/// Rows per task; a single row costs less than starting a task.
const TASK_ROWS: usize = 32;

/// The heads of one attention layer.
#[derive(Clone, Copy, Debug)]
pub struct HeadShape {
    pub heads: usize,
    /// Smaller than `heads` if several query heads share one key-value head.
    pub key_value_heads: usize,
    pub size: usize,
}

impl HeadShape {
    /// Length of a row of queries.
    pub fn query_width(&self) -> usize {
        self.heads * self.size
    }

    /// Length of a row of keys or of values.
    pub fn key_width(&self) -> usize {
        self.key_value_heads * self.size
    }
}

/// Cosines and sines of every position and frequency: (positions, head size / 2).
pub struct Rotary {
    cosines: Tensor,
    sines: Tensor,
    half: usize,
    backend: Backend,
}

impl Rotary {
    /// Computes the tables; frequency i is theta^(-2 i / head size).
    pub fn new(
        head_size: usize,
        positions_max: usize,
        theta: f32,
        backend: Backend,
        device: &Device,
    ) -> Result<Rotary> {
        let half = head_size / 2;
        let frequency = |index: usize| 1.0 / theta.powf(2.0 * index as f32 / head_size as f32);
        let angles: Vec<f32> = (0..positions_max)
            .flat_map(|position| (0..half).map(move |index| position as f32 * frequency(index)))
            .collect();
        let angles = Tensor::from_vec(angles, (positions_max, half), device)?;
        Ok(Rotary { cosines: angles.cos()?, sines: angles.sin()?, half, backend })
    }

    /// Splits joined rows into queries, keys and values, and rotates queries and keys to
    /// `positions`.
    pub fn split(
        &self,
        joined: &Tensor,
        shape: HeadShape,
        positions: &[usize],
    ) -> Result<(Tensor, Tensor, Tensor)> {
        let rows = joined.dim(0)?;
        assert_eq!(rows, positions.len(), "one position per row");
        let (query_width, key_width) = (shape.query_width(), shape.key_width());
        if self.backend == Backend::Kernels {
            return self.split_slices(joined, query_width, key_width, positions);
        }
        let positions: Vec<u32> = positions.iter().map(|&position| position as u32).collect();
        let positions = Tensor::from_vec(positions, rows, joined.device())?;
        let query = joined.narrow(1, 0, query_width)?;
        let key = joined.narrow(1, query_width, key_width)?;
        let value = joined.narrow(1, query_width + key_width, key_width)?.contiguous()?;
        Ok((self.turn(&query, &positions)?, self.turn(&key, &positions)?, value))
    }

    fn turn(&self, x: &Tensor, positions: &Tensor) -> Result<Tensor> {
        let (rows, width) = x.dims2()?;
        // (rows, heads x size) -> (rows, heads, 2, half)
        let x = x.contiguous()?.reshape((rows, width / (2 * self.half), 2, self.half))?;
        let (first, second) = (x.narrow(2, 0, 1)?, x.narrow(2, 1, 1)?);
        // (rows, half) -> (rows, 1, 1, half)
        let cosine = self.cosines.index_select(positions, 0)?.reshape((rows, 1, 1, self.half))?;
        let sine = self.sines.index_select(positions, 0)?.reshape((rows, 1, 1, self.half))?;
        let turned = Tensor::cat(
            &[
                (first.broadcast_mul(&cosine)? - second.broadcast_mul(&sine)?)?,
                (second.broadcast_mul(&cosine)? + first.broadcast_mul(&sine)?)?,
            ],
            2,
        )?;
        // (rows, heads, 2, half) -> (rows, heads x size)
        turned.reshape((rows, width))
    }

    fn split_slices(
        &self,
        joined: &Tensor,
        query_width: usize,
        key_width: usize,
        positions: &[usize],
    ) -> Result<(Tensor, Tensor, Tensor)> {
        let (rows, width) = joined.dims2()?;
        let (cosines, sines) = (Values::of(&self.cosines)?, Values::of(&self.sines)?);
        let (cosines, sines): (&[f32], &[f32]) = (&cosines, &sines);
        let values = Values::of(joined)?;
        let values: &[f32] = &values;
        let mut query = vec![0.0f32; rows * query_width];
        let mut key = vec![0.0f32; rows * key_width];
        let mut value = vec![0.0f32; rows * key_width];
        let half = self.half;
        (values.par_chunks_exact(width), positions.par_iter())
            .into_par_iter()
            .zip(query.par_chunks_exact_mut(query_width))
            .zip(key.par_chunks_exact_mut(key_width))
            .zip(value.par_chunks_exact_mut(key_width))
            .with_min_len(TASK_ROWS)
            .for_each(|((((joined, &position), query), key), value)| {
                let cosines = &cosines[position * half..(position + 1) * half];
                let sines = &sines[position * half..(position + 1) * half];
                turn_fast(&joined[..query_width], cosines, sines, query);
                turn_fast(&joined[query_width..][..key_width], cosines, sines, key);
                value.copy_from_slice(&joined[query_width + key_width..]);
            });
        let device = joined.device();
        Ok((
            Tensor::from_vec(query, (rows, query_width), device)?,
            Tensor::from_vec(key, (rows, key_width), device)?,
            Tensor::from_vec(value, (rows, key_width), device)?,
        ))
    }
}

vectorised! {
    fn turn_fast(row: &[f32], cosines: &[f32], sines: &[f32], output: &mut [f32]) = turn_row;
}

#[inline(always)]
fn turn_row(row: &[f32], cosines: &[f32], sines: &[f32], output: &mut [f32]) {
    let half = cosines.len();
    for (head, output) in row.chunks_exact(2 * half).zip(output.chunks_exact_mut(2 * half)) {
        let (first, second) = head.split_at(half);
        let (output_first, output_second) = output.split_at_mut(half);
        for index in 0..half {
            let (cosine, sine) = (cosines[index], sines[index]);
            output_first[index] = first[index] * cosine - second[index] * sine;
            output_second[index] = second[index] * cosine + first[index] * sine;
        }
    }
}
