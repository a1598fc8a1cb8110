//! Attention of query rows over keys and values: a prefix shared by several rows, and a tail per
//! row.
//!
//! The rows of all sessions are concatenated in one tensor. Each session (or image) is a range of
//! rows and attends only to itself.

use std::ops::Range;

use candle_core::{D, DType, Result, Tensor};
use rayon::prelude::*;

use crate::kernels::backend::{Backend, Values};
use crate::kernels::segment::{Segment, Visible, attend_row};
use crate::network::rotary::HeadShape;

/// Query rows per task: about 20 µs at the shipped model's size.
const TASK_ROWS: usize = 4;

/// The keys and values of each session in one layer; immutable.
pub struct Prefix {
    form: PrefixForm,
    shape: HeadShape,
}

enum PrefixForm {
    Kernels(Vec<Segment>),
    Tensors(Vec<(Tensor, Tensor)>),
}

/// The keys and values in one layer that each row has added after its session's prefix.
pub struct Tail {
    form: TailForm,
    shape: HeadShape,
}

enum TailForm {
    Kernels(Vec<Segment>),
    /// (rows, positions, key width); `None` before the first push.
    Tensors(DType, Option<(Tensor, Tensor)>),
}

/// The query rows of a session.
pub struct Group {
    pub session: usize,
    pub rows: Range<usize>,
}

impl Prefix {
    /// Makes prefixes of keys and values (rows, key width), where each session is a range of rows.
    pub fn new(
        key: &Tensor,
        value: &Tensor,
        sessions: &[Range<usize>],
        shape: HeadShape,
        backend: Backend,
    ) -> Result<Prefix> {
        let form = match backend {
            Backend::Kernels => {
                let (keys, values) = (Values::of(key)?, Values::of(value)?);
                let (keys, values): (&[f32], &[f32]) = (&keys, &values);
                let width = shape.key_width();
                let segment = |rows: &Range<usize>| {
                    let mut segment = Segment::new(shape, rows.len());
                    for row in rows.clone() {
                        let row = row * width..(row + 1) * width;
                        segment.push(&keys[row.clone()], &values[row]);
                    }
                    segment
                };
                PrefixForm::Kernels(sessions.par_iter().map(segment).collect())
            }
            Backend::Tensors(dtype) => {
                let part = |tensor: &Tensor, rows: &Range<usize>| {
                    tensor.narrow(0, rows.start, rows.len())?.to_dtype(dtype)?.contiguous()
                };
                let pairs = sessions.iter().map(|rows| Ok((part(key, rows)?, part(value, rows)?)));
                PrefixForm::Tensors(pairs.collect::<Result<_>>()?)
            }
        };
        Ok(Prefix { form, shape })
    }

    /// Concatenates the sessions of several prefixes.
    pub fn join(parts: Vec<Prefix>) -> Option<Prefix> {
        let mut parts = parts.into_iter();
        let mut joined = parts.next()?;
        for part in parts {
            match (&mut joined.form, part.form) {
                (PrefixForm::Kernels(all), PrefixForm::Kernels(more)) => all.extend(more),
                (PrefixForm::Tensors(all), PrefixForm::Tensors(more)) => all.extend(more),
                _ => unreachable!("prefixes of one network have one backend"),
            }
        }
        Some(joined)
    }

    /// Attention of rows that are the last positions of their session's prefix.
    ///
    /// With `causal`, a group's last row attends to all positions and each earlier row to one
    /// fewer.
    pub fn attend(&self, query: &Tensor, groups: &[Group], causal: bool) -> Result<Tensor> {
        match &self.form {
            PrefixForm::Kernels(segments) => {
                let seen = |row: usize| {
                    let group = group_of(groups, row);
                    let segment = &segments[group.session];
                    let hidden = if causal { group.rows.end - 1 - row } else { 0 };
                    [Visible { segment, count: segment.length() - hidden }]
                };
                attend_slices(query, self.shape, seen)
            }
            PrefixForm::Tensors(pairs) => {
                let parts = groups.iter().map(|group| {
                    let (key, value) = &pairs[group.session];
                    let query = query.narrow(0, group.rows.start, group.rows.len())?;
                    let query = by_head(&query, self.shape.heads, self.shape.size)?;
                    let query = query.to_dtype(key.dtype())?;
                    let (key, value) = (self.shape.repeat(key)?, self.shape.repeat(value)?);
                    let mut scores = scores(&query, &key, self.shape.size)?;
                    if causal {
                        scores = scores.broadcast_add(&causal_mask(&scores)?)?;
                    }
                    let weights = softmax(&scores)?.to_dtype(value.dtype())?;
                    from_heads(&weights.matmul(&value)?)?.to_dtype(DType::F32)
                });
                Tensor::cat(&parts.collect::<Result<Vec<_>>>()?, 0)
            }
        }
    }
}

impl Tail {
    /// Empty tails of `rows` rows.
    pub fn new(rows: usize, capacity: usize, shape: HeadShape, backend: Backend) -> Tail {
        let form = match backend {
            Backend::Kernels => TailForm::Kernels(vec![Segment::new(shape, capacity); rows]),
            Backend::Tensors(dtype) => TailForm::Tensors(dtype, None),
        };
        Tail { form, shape }
    }

    /// Appends one position to every row.
    pub fn push(&mut self, key: &Tensor, value: &Tensor) -> Result<()> {
        match &mut self.form {
            TailForm::Kernels(segments) => {
                let (keys, values) = (Values::of(key)?, Values::of(value)?);
                let width = self.shape.key_width();
                let rows = keys.chunks_exact(width).zip(values.chunks_exact(width));
                for (segment, (key, value)) in segments.iter_mut().zip(rows) {
                    segment.push(key, value);
                }
            }
            TailForm::Tensors(dtype, pair) => {
                // (rows, key width) -> (rows, 1, key width)
                let new = |tensor: &Tensor| tensor.to_dtype(*dtype)?.unsqueeze(1);
                let (key, value) = (new(key)?, new(value)?);
                *pair = Some(match pair.take() {
                    None => (key, value),
                    Some((keys, values)) => {
                        (Tensor::cat(&[keys, key], 1)?, Tensor::cat(&[values, value], 1)?)
                    }
                });
            }
        }
        Ok(())
    }

    /// Row i becomes a copy of row `parents[i]`; rows that are not a parent are dropped.
    pub fn fork(&mut self, parents: &[usize]) -> Result<()> {
        match &mut self.form {
            TailForm::Kernels(segments) => {
                let mut children = vec![0usize; segments.len()];
                parents.iter().for_each(|&parent| children[parent] += 1);
                let child = |&parent: &usize| {
                    children[parent] -= 1;
                    // The last child takes the segment over, the others copy it.
                    match children[parent] {
                        0 => std::mem::take(&mut segments[parent]),
                        _ => segments[parent].clone(),
                    }
                };
                *segments = parents.iter().map(child).collect();
            }
            TailForm::Tensors(_, Some((keys, values))) => {
                let rows: Vec<u32> = parents.iter().map(|&parent| parent as u32).collect();
                let rows = Tensor::new(rows, keys.device())?;
                (*keys, *values) = (keys.index_select(&rows, 0)?, values.index_select(&rows, 0)?);
            }
            TailForm::Tensors(_, None) => {}
        }
        Ok(())
    }

    /// Attention of each row over its session's prefix and its own tail.
    pub fn attend(&self, query: &Tensor, prefix: &Prefix, groups: &[Group]) -> Result<Tensor> {
        match (&self.form, &prefix.form) {
            (TailForm::Kernels(tails), PrefixForm::Kernels(prefixes)) => {
                let seen = |row: usize| {
                    let prefix = &prefixes[group_of(groups, row).session];
                    [prefix, &tails[row]]
                        .map(|segment| Visible { segment, count: segment.length() })
                };
                attend_slices(query, self.shape, seen)
            }
            (TailForm::Tensors(_, Some(tails)), PrefixForm::Tensors(prefixes)) => {
                let parts = groups.iter().map(|group| {
                    attend_tensors(query, tails, &prefixes[group.session], group, self.shape)
                });
                Tensor::cat(&parts.collect::<Result<Vec<_>>>()?, 0)
            }
            _ => candle_core::bail!("attention: expected a filled tail and prefix of one backend"),
        }
    }
}

fn group_of(groups: &[Group], row: usize) -> &Group {
    let index = groups.partition_point(|group| group.rows.end <= row);
    &groups[index]
}

fn attend_slices<'a, const SEGMENTS: usize>(
    query: &Tensor,
    shape: HeadShape,
    seen: impl Fn(usize) -> [Visible<'a>; SEGMENTS] + Sync,
) -> Result<Tensor> {
    let (rows, width) = query.dims2()?;
    let query_values = Values::of(query)?;
    let values: &[f32] = &query_values;
    let mut output = vec![0.0f32; rows * width];
    values
        .par_chunks_exact(width)
        .zip(output.par_chunks_exact_mut(width))
        .enumerate()
        .with_min_len(TASK_ROWS)
        .for_each_init(Vec::new, |scores, (row, (query, output))| {
            attend_row(query, &seen(row), shape, scores, output);
        });
    Tensor::from_vec(output, (rows, width), query.device())
}

fn attend_tensors(
    query: &Tensor,
    (tail_keys, tail_values): &(Tensor, Tensor),
    (key, value): &(Tensor, Tensor),
    group: &Group,
    shape: HeadShape,
) -> Result<Tensor> {
    let (start, rows) = (group.rows.start, group.rows.len());
    let query = by_head(&query.narrow(0, start, rows)?, shape.heads, shape.size)?;
    let query = query.to_dtype(key.dtype())?;
    let prefix_length = key.dim(0)?;
    let (key, value) = (shape.repeat(key)?, shape.repeat(value)?);
    let tail = |tensor: &Tensor| {
        let tensor = tensor.narrow(0, start, rows)?;
        let positions = tensor.dim(1)?;
        // (rows, positions, key width) -> (rows x positions, key width)
        // -> (heads, rows, positions, size)
        let flat = tensor.contiguous()?.flatten_to(1)?;
        shape.repeat(&flat)?.reshape((shape.heads, rows, positions, shape.size))
    };
    let (tail_key, tail_value) = (tail(tail_keys)?, tail(tail_values)?);
    // (heads, rows, size) -> (heads, rows, 1, size) x (heads, rows, size, positions)
    let own = query.unsqueeze(2)?.contiguous()?;
    let own = own.matmul(&tail_key.transpose(2, 3)?.contiguous()?)?.squeeze(2)?;
    let own = (own.to_dtype(DType::F32)? / (shape.size as f64).sqrt())?;
    let weights = softmax(&Tensor::cat(&[scores(&query, &key, shape.size)?, own], 2)?)?;
    let weights = weights.to_dtype(value.dtype())?;
    let shared = weights.narrow(2, 0, prefix_length)?.contiguous()?.matmul(&value)?;
    let positions = tail_value.dim(2)?;
    let own = weights.narrow(2, prefix_length, positions)?.unsqueeze(2)?.contiguous()?;
    let own = own.matmul(&tail_value)?.squeeze(2)?.to_dtype(DType::F32)?;
    from_heads(&(shared.to_dtype(DType::F32)? + own)?)
}

impl HeadShape {
    /// (positions, key width) -> (heads, positions, size), with shared heads repeated.
    fn repeat(self, x: &Tensor) -> Result<Tensor> {
        let x = by_head(x, self.key_value_heads, self.size)?;
        let positions = x.dim(1)?;
        let times = self.heads / self.key_value_heads;
        x.unsqueeze(1)?
            .expand((self.key_value_heads, times, positions, self.size))?
            .contiguous()?
            .reshape((self.heads, positions, self.size))
    }
}

/// (rows, heads x size) -> (heads, rows, size)
fn by_head(x: &Tensor, heads: usize, size: usize) -> Result<Tensor> {
    x.contiguous()?.reshape((x.dim(0)?, heads, size))?.transpose(0, 1)?.contiguous()
}

/// (heads, rows, size) -> (rows, heads x size)
fn from_heads(x: &Tensor) -> Result<Tensor> {
    x.transpose(0, 1)?.contiguous()?.flatten_from(1)
}

/// (heads, rows, size) x (heads, positions, size) -> (heads, rows, positions)
fn scores(query: &Tensor, key: &Tensor, size: usize) -> Result<Tensor> {
    let products = query.matmul(&key.transpose(1, 2)?.contiguous()?)?.to_dtype(DType::F32)?;
    products / (size as f64).sqrt()
}

fn softmax(scores: &Tensor) -> Result<Tensor> {
    let largest = scores.max_keepdim(D::Minus1)?;
    let powers = scores.broadcast_sub(&largest)?.exp()?;
    powers.broadcast_div(&powers.sum_keepdim(D::Minus1)?)
}

/// Minus infinity where a row must not attend to a later position; the last row attends to all.
fn causal_mask(scores: &Tensor) -> Result<Tensor> {
    let (_, rows, positions) = scores.dims3()?;
    let hidden = |row: usize, position: usize| position + rows > positions + row;
    let mask: Vec<f32> = (0..rows * positions)
        .map(|at| if hidden(at / positions, at % positions) { f32::NEG_INFINITY } else { 0.0 })
        .collect();
    Tensor::from_vec(mask, (1, rows, positions), scores.device())
}
