//! Keys and values of consecutive positions, in the layout for one query row at a time.
//!
//! Keys are stored in blocks of eight positions, dimension by dimension. Eight scores are
//! accumulated in one vector register, without a horizontal sum.

use crate::kernels::activation::exponential;
use crate::kernels::backend::vectorised;
use crate::network::rotary::HeadShape;

/// Positions per block of keys.
pub const BLOCK: usize = 8;
/// A segment grows by this many positions at a time: doubling would take up to twice the memory.
pub const GROWTH: usize = 64;
/// Independent sums per score, to hide the latency of multiply-add.
const CHAINS: usize = 4;

/// Keys and values of consecutive positions; grows by `push`.
#[derive(Clone, Default)]
pub struct Segment {
    heads: Vec<Head>,
    length: usize,
}

#[derive(Clone, Default)]
struct Head {
    /// (blocks, size, 8)
    keys: Vec<f32>,
    /// (positions, size)
    values: Vec<f32>,
}

impl Segment {
    /// An empty segment with capacity for `capacity` positions.
    pub fn new(shape: HeadShape, capacity: usize) -> Segment {
        let head = || Head {
            keys: Vec::with_capacity(capacity.div_ceil(BLOCK) * BLOCK * shape.size),
            values: Vec::with_capacity(capacity * shape.size),
        };
        Segment { heads: (0..shape.key_value_heads).map(|_| head()).collect(), length: 0 }
    }

    /// Number of positions.
    pub fn length(&self) -> usize {
        self.length
    }

    /// Appends one position: a row of keys and a row of values, one head after the other.
    pub fn push(&mut self, key: &[f32], value: &[f32]) {
        let size = key.len() / self.heads.len();
        let lane = self.length % BLOCK;
        let parts = key.chunks_exact(size).zip(value.chunks_exact(size));
        for (head, (key, value)) in self.heads.iter_mut().zip(parts) {
            if lane == 0 {
                if head.keys.len() == head.keys.capacity() {
                    head.keys.reserve_exact(GROWTH * size);
                }
                head.keys.resize(head.keys.len() + size * BLOCK, 0.0);
            }
            let start = self.length / BLOCK * size * BLOCK;
            let block = &mut head.keys[start..start + size * BLOCK];
            for (dimension, &number) in key.iter().enumerate() {
                block[dimension * BLOCK + lane] = number;
            }
            if head.values.len() == head.values.capacity() {
                head.values.reserve_exact(GROWTH * size);
            }
            head.values.extend_from_slice(value);
        }
        self.length += 1;
    }
}

/// Positions of memory that a segment with capacity for [`GROWTH`] takes when it has `positions`.
pub fn tail_positions(positions: usize) -> usize {
    positions.next_multiple_of(GROWTH)
}

/// The first `count` positions of a segment: those that a query may attend to.
#[derive(Clone, Copy)]
pub struct Visible<'a> {
    pub segment: &'a Segment,
    pub count: usize,
}

vectorised! {
    fn attend_fast(
        query: &[f32],
        seen: &[Visible<'_>],
        shape: HeadShape,
        scores: &mut Vec<f32>,
        output: &mut [f32],
    ) = attend_heads;
}

/// Attention of one row of queries over all visible positions; `scores` is scratch space.
pub fn attend_row(
    query: &[f32],
    seen: &[Visible<'_>],
    shape: HeadShape,
    scores: &mut Vec<f32>,
    output: &mut [f32],
) {
    attend_fast(query, seen, shape, scores, output);
}

#[inline(always)]
fn attend_heads(
    query: &[f32],
    seen: &[Visible<'_>],
    shape: HeadShape,
    scores: &mut Vec<f32>,
    output: &mut [f32],
) {
    let size = shape.size;
    let scale = 1.0 / (size as f32).sqrt();
    let queries_per_key = shape.heads / shape.key_value_heads;
    let total: usize = seen.iter().map(|visible| visible.count).sum();
    scores.resize(total + BLOCK, 0.0);
    for (head, (query, output)) in
        query.chunks_exact(size).zip(output.chunks_exact_mut(size)).enumerate()
    {
        let mut offset = 0;
        for visible in seen {
            let keys = &visible.segment.heads[head / queries_per_key].keys;
            score(query, keys, visible.count, &mut scores[offset..]);
            offset += visible.count;
        }
        let sum = soften(&mut scores[..total], scale);
        output.fill(0.0);
        let mut offset = 0;
        for visible in seen {
            let values = &visible.segment.heads[head / queries_per_key].values;
            weigh(&scores[offset..offset + visible.count], values, output);
            offset += visible.count;
        }
        let normaliser = 1.0 / sum;
        output.iter_mut().for_each(|number| *number *= normaliser);
    }
}

/// Products of the query with `count` keys, in whole blocks: writes up to seven extra numbers.
#[inline(always)]
fn score(query: &[f32], keys: &[f32], count: usize, scores: &mut [f32]) {
    let size = query.len();
    for block in 0..count.div_ceil(BLOCK) {
        let keys = &keys[block * size * BLOCK..(block + 1) * size * BLOCK];
        let mut chains = [[0.0f32; BLOCK]; CHAINS];
        let quads = query.chunks_exact(CHAINS);
        let rest = quads.remainder();
        for (quad, keys) in quads.zip(keys.chunks_exact(CHAINS * BLOCK)) {
            for chain in 0..CHAINS {
                for lane in 0..BLOCK {
                    let key = keys[chain * BLOCK + lane];
                    chains[chain][lane] = quad[chain].mul_add(key, chains[chain][lane]);
                }
            }
        }
        for (&number, keys) in
            rest.iter().zip(keys[(size - rest.len()) * BLOCK..].chunks_exact(BLOCK))
        {
            for lane in 0..BLOCK {
                chains[0][lane] = number.mul_add(keys[lane], chains[0][lane]);
            }
        }
        let scores = &mut scores[block * BLOCK..(block + 1) * BLOCK];
        for lane in 0..BLOCK {
            scores[lane] =
                (chains[0][lane] + chains[1][lane]) + (chains[2][lane] + chains[3][lane]);
        }
    }
}

/// Replaces scores by e^(scale x (score - largest)) and returns their sum.
#[inline(always)]
fn soften(scores: &mut [f32], scale: f32) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; BLOCK];
    let chunks = scores.chunks_exact(BLOCK);
    let mut largest = chunks.remainder().iter().fold(f32::NEG_INFINITY, |a, &b| a.max(b));
    for chunk in chunks {
        for lane in 0..BLOCK {
            lanes[lane] = if chunk[lane] > lanes[lane] { chunk[lane] } else { lanes[lane] };
        }
    }
    largest = lanes.iter().fold(largest, |a, &b| a.max(b));
    let mut sums = [0.0f32; BLOCK];
    let mut chunks = scores.chunks_exact_mut(BLOCK);
    for chunk in &mut chunks {
        for lane in 0..BLOCK {
            chunk[lane] = exponential((chunk[lane] - largest) * scale);
            sums[lane] += chunk[lane];
        }
    }
    let mut sum: f32 = sums.iter().sum();
    for score in chunks.into_remainder() {
        *score = exponential((*score - largest) * scale);
        sum += *score;
    }
    sum
}

/// Adds the weighted sum of the values to `output`.
#[inline(always)]
fn weigh(weights: &[f32], values: &[f32], output: &mut [f32]) {
    let size = output.len();
    let mut start = 0;
    while size - start >= 64 {
        weigh_part::<64>(weights, values, size, start, output);
        start += 64;
    }
    while size - start >= 8 {
        weigh_part::<8>(weights, values, size, start, output);
        start += 8;
    }
    while start < size {
        weigh_part::<1>(weights, values, size, start, output);
        start += 1;
    }
}

#[inline(always)]
fn weigh_part<const WIDTH: usize>(
    weights: &[f32],
    values: &[f32],
    size: usize,
    start: usize,
    output: &mut [f32],
) {
    let mut sums = [0.0f32; WIDTH];
    sums.copy_from_slice(&output[start..start + WIDTH]);
    for (weight, value) in weights.iter().zip(values.chunks_exact(size)) {
        let value = &value[start..start + WIDTH];
        for lane in 0..WIDTH {
            sums[lane] = weight.mul_add(value[lane], sums[lane]);
        }
    }
    output[start..start + WIDTH].copy_from_slice(&sums);
}
