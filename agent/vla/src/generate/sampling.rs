//! Reproducible token sampling: each candidate has its own seeded random stream.

use anyhow::{Result, ensure};

use crate::kernels::activation::exponential;
use crate::kernels::backend::vectorised;

/// The random numbers of one candidate: a pure function of seed, candidate and position.
#[derive(Clone, Debug)]
pub struct Stream {
    state: u64,
}

/// A token with its log-probability at temperature 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Draw {
    pub token: u32,
    pub log_probability: f64,
}

/// SplitMix64's increment: the odd number nearest to 2^64 / golden ratio.
const STEP: u64 = 0x9E37_79B9_7F4A_7C15;

impl Stream {
    /// The stream of one candidate of one decision.
    pub fn new(seed: u64, candidate: usize) -> Stream {
        Stream { state: mix(mix(seed.wrapping_add(STEP)) ^ (candidate as u64).wrapping_mul(STEP)) }
    }

    /// A number in 0..1, never 1, with 53 random bits.
    pub fn uniform(&mut self) -> f64 {
        self.state = self.state.wrapping_add(STEP);
        (mix(self.state) >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// SplitMix64's finaliser.
fn mix(mut bits: u64) -> u64 {
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    bits ^ (bits >> 31)
}

/// Samples a token from softmax(logits / temperature) by inverting its cumulative distribution at
/// `uniform`.
///
/// Temperature 0 selects the first of the largest logits. Weights are f32, their sums f64.
pub fn draw(logits: &[f32], temperature: f32, uniform: f64) -> Result<Draw> {
    let (best, largest) = argmax(logits);
    ensure!(largest.is_finite(), "logits: expected finite numbers, got {largest}");
    let mut weights = vec![0.0f32; logits.len()];
    let natural = soften_fast(logits, largest, 1.0, &mut weights);
    let token = if temperature == 0.0 {
        best
    } else {
        let total = if temperature == 1.0 {
            natural
        } else {
            soften_fast(logits, largest, 1.0 / temperature, &mut weights)
        };
        index_at_sum(&weights, uniform * total).unwrap_or(best)
    };
    let log_probability = f64::from(logits[token] - largest) - natural.ln();
    Ok(Draw { token: token as u32, log_probability })
}

/// The given token with its log-probability at temperature 1.
pub fn forced(logits: &[f32], token: u32) -> Result<Draw> {
    let (_, largest) = argmax(logits);
    ensure!(largest.is_finite(), "logits: expected finite numbers, got {largest}");
    let natural = soften_fast(logits, largest, 1.0, &mut vec![0.0f32; logits.len()]);
    let log_probability = f64::from(logits[token as usize] - largest) - natural.ln();
    Ok(Draw { token, log_probability })
}

/// The first of the largest logits, or the first NaN.
fn argmax(logits: &[f32]) -> (usize, f32) {
    let mut best = 0;
    for (index, &logit) in logits.iter().enumerate() {
        if logit.is_nan() {
            return (index, logit);
        }
        if logit > logits[best] {
            best = index;
        }
    }
    (best, logits[best])
}

vectorised! {
    fn soften_fast(logits: &[f32], largest: f32, scale: f32, weights: &mut [f32]) -> f64 = soften;
}

/// Writes e^(scale x (logit - largest)) and returns the sum.
#[inline(always)]
fn soften(logits: &[f32], largest: f32, scale: f32, weights: &mut [f32]) -> f64 {
    for (weight, &logit) in weights.iter_mut().zip(logits) {
        *weight = exponential((logit - largest) * scale);
    }
    // Eight partial sums in a fixed order.
    let mut sums = [0.0f64; 8];
    let chunks = weights.chunks_exact(8);
    let rest: f64 = chunks.remainder().iter().copied().map(f64::from).sum();
    for chunk in chunks {
        for lane in 0..8 {
            sums[lane] += f64::from(chunk[lane]);
        }
    }
    sums.iter().sum::<f64>() + rest
}

/// The first index at which the running sum exceeds `target`.
fn index_at_sum(weights: &[f32], target: f64) -> Option<usize> {
    let mut sum = 0.0f64;
    weights.iter().position(|&weight| {
        sum += f64::from(weight);
        sum > target
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn temperature_zero_takes_the_first_of_the_largest() -> Result<()> {
        let draw = draw(&[0.0, 3.0, 3.0, 1.0], 0.0, 0.99)?;
        assert_eq!(draw.token, 1);
        let expected = -((2.0f64 + (-3.0f64).exp() + (-2.0f64).exp()).ln());
        assert!((draw.log_probability - expected).abs() < 1e-6);
        Ok(())
    }

    #[test]
    fn frequencies_follow_the_softmax_at_every_temperature() -> Result<()> {
        let logits = [0.5f32, -1.0, 2.0, 0.0, 1.5];
        for temperature in [0.5f32, 1.0, 2.0] {
            let mut counts = [0u32; 5];
            let draws = 40_000;
            for index in 0..draws {
                let uniform = Stream::new(7, index).uniform();
                counts[draw(&logits, temperature, uniform)?.token as usize] += 1;
            }
            let weights = logits.map(|logit| f64::from(logit / temperature).exp());
            for (count, weight) in counts.iter().zip(weights) {
                let expected = weight / weights.iter().sum::<f64>();
                let deviation = (expected * (1.0 - expected) / draws as f64).sqrt();
                let error = (f64::from(*count) / draws as f64 - expected).abs();
                assert!(error < 4.0 * deviation, "temperature {temperature}: {error}");
            }
        }
        Ok(())
    }

    #[test]
    fn streams_of_seeds_and_candidates_differ_and_repeat() {
        let first = |seed, candidate| Stream::new(seed, candidate).uniform();
        assert_eq!(first(1, 0), first(1, 0));
        let firsts = [first(1, 0), first(1, 1), first(2, 0), first(2, 1), first(0, 0)];
        for (index, a) in firsts.iter().enumerate() {
            assert!(firsts[index + 1..].iter().all(|b| a != b), "{firsts:?}");
        }
    }

    #[test]
    fn a_forced_token_has_the_log_probability_that_it_has_when_it_is_drawn() -> Result<()> {
        let logits = [0.5f32, -1.0, 2.0, 0.0, 1.5];
        for index in 0..20 {
            let drawn = draw(&logits, 1.0, Stream::new(3, index).uniform())?;
            assert_eq!(forced(&logits, drawn.token)?, drawn);
        }
        Ok(())
    }

    #[test]
    fn logits_that_are_not_finite_are_refused() {
        for bad in [f32::NAN, f32::INFINITY] {
            assert!(draw(&[0.0, bad, 1.0], 1.0, 0.5).is_err());
        }
    }
}
