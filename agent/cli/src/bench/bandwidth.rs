//! Measures how fast this machine reads a buffer as large as a step's weights, from memory or from
//! cache.

use std::hint::black_box;
use std::time::Instant;

use rayon::prelude::*;

/// Maximum size of the buffer: no cache holds as much, and beside the weights of a 7B checkpoint
/// memory has no room for their number of bytes again.
const BYTES_MAX: usize = 1 << 30;
/// Number of passes; the fastest counts.
const PASSES: usize = 40;
/// Independent partial sums, so that additions do not wait for each other.
const SUMS: usize = 64;

/// Bytes per second over all threads: the fastest of several passes over a buffer of `bytes`, at
/// most [`BYTES_MAX`].
pub fn measure(bytes: usize) -> f64 {
    let values = vec![1.0_f32; (bytes.min(BYTES_MAX) / size_of::<f32>()).max(SUMS)];
    let share = values.len().div_ceil(rayon::current_num_threads());
    let pass = || {
        let start = Instant::now();
        values.par_chunks(share).for_each(|values| {
            black_box(sum(black_box(values)));
        });
        start.elapsed().as_secs_f64()
    };
    let fastest = (0..PASSES).map(|_| pass()).fold(f64::INFINITY, f64::min);
    size_of_val(values.as_slice()) as f64 / fastest
}

fn sum(values: &[f32]) -> f32 {
    let mut sums = [0.0_f32; SUMS];
    for values in values.chunks_exact(SUMS) {
        sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
    }
    sums.iter().sum()
}
