//! Row-wise activations: the exact (erf) GELU of the vision towers and the gated SiLU of the
//! decoder.

use candle_core::{Result, Tensor};
use rayon::prelude::*;

use crate::kernels::backend::{Backend, Values, vectorised};

/// Elements per task: enough work to justify another thread.
const TASK_LENGTH: usize = 1 << 14;

/// x / 2 x (1 + erf(x / sqrt 2)).
pub fn gelu(rows: &Tensor, backend: Backend) -> Result<Tensor> {
    match backend {
        Backend::Kernels => {
            let input = Values::of(rows)?;
            let input: &[f32] = &input;
            let mut output = vec![0.0f32; input.len()];
            input
                .par_chunks(TASK_LENGTH)
                .zip(output.par_chunks_mut(TASK_LENGTH))
                .for_each(|(input, output)| gelu_fast(input, output));
            Tensor::from_vec(output, rows.shape(), rows.device())
        }
        Backend::Tensors(_) => rows.gelu_erf(),
    }
}

/// silu(gate) x up, where a row contains all gates followed by all ups: (n, 2 x width) -> (n,
/// width).
pub fn gated_silu(rows: &Tensor, backend: Backend) -> Result<Tensor> {
    let (count, double) = rows.dims2()?;
    let width = double / 2;
    match backend {
        Backend::Kernels => {
            let input = Values::of(rows)?;
            let input: &[f32] = &input;
            let mut output = vec![0.0f32; count * width];
            let rows_per_task = (TASK_LENGTH / width).max(1);
            input
                .par_chunks(rows_per_task * double)
                .zip(output.par_chunks_mut(rows_per_task * width))
                .for_each(|(input, output)| gated_silu_fast(input, output, width));
            Tensor::from_vec(output, (count, width), rows.device())
        }
        Backend::Tensors(_) => {
            rows.narrow(1, 0, width)?.silu()? * rows.narrow(1, width, width)?.contiguous()?
        }
    }
}

vectorised! {
    fn gelu_fast(input: &[f32], output: &mut [f32]) = gelu_slice;
}

vectorised! {
    fn gated_silu_fast(input: &[f32], output: &mut [f32], width: usize) = gated_silu_rows;
}

#[inline(always)]
fn gelu_slice(input: &[f32], output: &mut [f32]) {
    for (output, &x) in output.iter_mut().zip(input) {
        *output = 0.5 * x * (1.0 + error_function(x * std::f32::consts::FRAC_1_SQRT_2));
    }
}

#[inline(always)]
fn gated_silu_rows(input: &[f32], output: &mut [f32], width: usize) {
    for (input, output) in input.chunks_exact(2 * width).zip(output.chunks_exact_mut(width)) {
        let (gates, ups) = input.split_at(width);
        for ((output, &gate), &up) in output.iter_mut().zip(gates).zip(ups) {
            *output = gate / (1.0 + exponential(-gate)) * up;
        }
    }
}

/// erf by Abramowitz and Stegun 7.1.26, without branches; the error is at most 1.5e-7.
#[inline(always)]
fn error_function(x: f32) -> f32 {
    let size = x.abs();
    let t = 1.0 / 0.327_591_1f32.mul_add(size, 1.0);
    let polynomial = 1.061_405_4f32
        .mul_add(t, -1.453_152)
        .mul_add(t, 1.421_413_7)
        .mul_add(t, -0.284_496_74)
        .mul_add(t, 0.254_829_6)
        * t;
    (1.0 - polynomial * exponential(-size * size)).copysign(x)
}

/// e^x within two units in the last place, without branches; 0 below -87, finite above 88.
#[inline(always)]
pub fn exponential(x: f32) -> f32 {
    // x = n ln 2 + r with |r| <= ln 2 / 2; ln 2 in two parts keeps r exact (Cody and Waite).
    let x = x.clamp(-87.3, 88.0);
    // Adding 1.5 x 2^23 rounds to the nearest integer, which is then in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = n.mul_add(-0.693_359_4, x);
    let r = n.mul_add(2.121_944_4e-4, r);
    // Taylor's series to the seventh order: its error at |r| = 0.35 is below 2e-8.
    let series = (1.0f32 / 5040.0)
        .mul_add(r, 1.0 / 720.0)
        .mul_add(r, 1.0 / 120.0)
        .mul_add(r, 1.0 / 24.0)
        .mul_add(r, 1.0 / 6.0)
        .mul_add(r, 0.5)
        .mul_add(r, 1.0)
        .mul_add(r, 1.0);
    let power = f32::from_bits((n as i32 + 127).cast_unsigned() << 23);
    if x <= -87.3 { 0.0 } else { series * power }
}

#[cfg(test)]
mod tests {
    use candle_core::DType;

    use super::*;

    #[test]
    fn exponential_is_within_two_units_in_the_last_place() {
        for step in -8700..8800 {
            let x = step as f32 / 100.0;
            let exact = f64::from(x).exp();
            let error = (f64::from(exponential(x)) - exact).abs() / exact;
            assert!(error < 2.4e-7, "exp({x}): relative error {error}");
        }
        assert_eq!(exponential(f32::NEG_INFINITY), 0.0);
        assert_eq!(exponential(0.0), 1.0);
    }

    #[test]
    fn gelu_kernel_equals_the_tensor_operation() -> Result<()> {
        let values: Vec<f32> = (-1000..1000).map(|step| step as f32 / 125.0).collect();
        let rows = Tensor::from_vec(values, (10, 200), &candle_core::Device::Cpu)?;
        let kernel = gelu(&rows, Backend::Kernels)?;
        let difference = (kernel - gelu(&rows, Backend::Tensors(DType::F32))?)?.abs()?.max_all()?;
        assert!(difference.to_scalar::<f32>()? < 1e-6);
        Ok(())
    }

    #[test]
    fn gated_silu_kernel_equals_the_tensor_operation() -> Result<()> {
        let values: Vec<f32> = (-1000..1000).map(|step| step as f32 / 50.0).collect();
        let rows = Tensor::from_vec(values, (10, 200), &candle_core::Device::Cpu)?;
        let kernel = gated_silu(&rows, Backend::Kernels)?;
        let difference =
            (kernel - gated_silu(&rows, Backend::Tensors(DType::F32))?)?.abs()?.max_all()?;
        assert!(difference.to_scalar::<f32>()? < 1e-5);
        Ok(())
    }
}
