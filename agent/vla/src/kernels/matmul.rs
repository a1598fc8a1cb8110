//! The product of activation rows with a packed weight. A row's bits do not depend on other rows.
//!
//! Every output is one chain of fused multiply-adds over the inputs in order, in every tile. The
//! results are therefore bitwise equal for any number of rows, sessions and threads.

use std::ops::Range;

use half::bf16;
use rayon::prelude::*;

use crate::kernels::tile::{self, PANEL, Stored, Vectors};

/// Rows per task: with 256 inputs they stay in the L2 cache while the panels are streamed.
const TASK_ROWS: usize = 96;
/// Minimum number of multiply-adds per task; with fewer, another thread costs more than it gains.
const TASK_WORK_MIN: usize = 1 << 17;

/// A weight of `outputs` x `inputs` stored in panels of sixteen outputs, input by input.
pub struct PackedWeight {
    outputs: usize,
    inputs: usize,
    panels: Panels,
}

/// The bits of a weight in memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WeightFormat {
    /// The checkpoint's values: 16 bits, or 32 where these are not exact.
    #[default]
    Exact,
    /// Integers of 8 bits with one scale per output: half the memory, about half the time of products
    /// with up to five rows, and slightly different results.
    Eight,
}

/// The weights in the smallest format that represents all of them exactly, or in 8 bits.
enum Panels {
    Half(Vec<bf16>),
    Full(Vec<f32>),
    /// With the scale of each output.
    Eight(Vec<i8>, Vec<f32>),
}

impl PackedWeight {
    /// Packs a row-major weight in the layout of checkpoints: one row per output.
    pub fn pack(
        weight: &[f32],
        outputs: usize,
        inputs: usize,
        format: WeightFormat,
    ) -> PackedWeight {
        assert_eq!(weight.len(), outputs * inputs, "weight of {outputs} x {inputs}");
        let panels = if format == WeightFormat::Eight {
            let scales: Vec<f32> = weight.par_chunks_exact(inputs).map(scale_of).collect();
            let eight =
                |value: f32, output: usize| (value / scales[output]).round_ties_even() as i8;
            Panels::Eight(panels(weight, outputs, inputs, eight), scales)
        } else if is_exact_in_half(weight) {
            Panels::Half(panels(weight, outputs, inputs, |value, _| bf16::from_f32(value)))
        } else {
            Panels::Full(panels(weight, outputs, inputs, |value, _| value))
        };
        PackedWeight { outputs, inputs, panels }
    }

    /// Number of outputs per row.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Size of the panels in bytes.
    pub fn bytes(&self) -> usize {
        match &self.panels {
            Panels::Half(panels) => size_of_val(panels.as_slice()),
            Panels::Full(panels) => size_of_val(panels.as_slice()),
            Panels::Eight(panels, scales) => panels.len() + size_of_val(scales.as_slice()),
        }
    }

    /// `rows` x weight + `bias` + `residual`, row-major.
    pub fn multiply(
        &self,
        rows: &[f32],
        bias: Option<&[f32]>,
        residual: Option<&[f32]>,
    ) -> Vec<f32> {
        self.multiply_with(Vectors::widest(), rows, bias, residual)
    }

    fn multiply_with(
        &self,
        vectors: Vectors,
        rows: &[f32],
        bias: Option<&[f32]>,
        residual: Option<&[f32]>,
    ) -> Vec<f32> {
        let (inputs, outputs) = (self.inputs, self.outputs);
        let count = rows.len() / inputs;
        assert_eq!(rows.len(), count * inputs, "rows of {inputs} inputs");
        let length = count * outputs;
        assert!(bias.is_none_or(|bias| bias.len() == outputs));
        assert!(residual.is_none_or(|residual| residual.len() == length));
        let mut output: Vec<f32> = Vec::with_capacity(length);
        let scales = match &self.panels {
            Panels::Eight(_, scales) => Some(scales.as_slice()),
            Panels::Half(_) | Panels::Full(_) => None,
        };
        let target = Output { start: output.as_mut_ptr(), outputs, scales, bias, residual };
        match &self.panels {
            Panels::Half(panels) => Product { inputs, panels, rows, target }.run(vectors, count),
            Panels::Full(panels) => Product { inputs, panels, rows, target }.run(vectors, count),
            Panels::Eight(panels, _) => {
                Product { inputs, panels, rows, target }.run(vectors, count)
            }
        }
        // SAFETY: the tasks of `run` cover every row and every panel, so all elements are written.
        unsafe { output.set_len(length) };
        output
    }
}

/// Whether all numbers are exact in 16 bits.
pub fn is_exact_in_half(numbers: &[f32]) -> bool {
    numbers.par_iter().all(|&number| bf16::from_f32(number).to_f32() == number)
}

/// All panels in order; the last one is padded with zeros.
fn panels<W: Stored>(
    weight: &[f32],
    outputs: usize,
    inputs: usize,
    convert: impl Fn(f32, usize) -> W + Sync,
) -> Vec<W> {
    let zero = convert(0.0, 0);
    let mut panels = vec![zero; outputs.div_ceil(PANEL) * PANEL * inputs];
    let fill = |(panel, (part, rows)): (&mut [W], (usize, &[f32]))| {
        for (lane, row) in rows.chunks_exact(inputs).enumerate() {
            for (input, &value) in row.iter().enumerate() {
                panel[input * PANEL + lane] = convert(value, part * PANEL + lane);
            }
        }
    };
    let rows = weight.par_chunks(PANEL * inputs).enumerate();
    panels.par_chunks_exact_mut(PANEL * inputs).zip(rows).for_each(fill);
    panels
}

/// The largest number of a row becomes 127; a row of zeros has any scale.
fn scale_of(row: &[f32]) -> f32 {
    let largest = row.iter().fold(0.0f32, |largest, value| largest.max(value.abs()));
    if largest > 0.0 { largest / 127.0 } else { 1.0 }
}

/// A product in progress.
pub struct Product<'a, W> {
    inputs: usize,
    panels: &'a [W],
    rows: &'a [f32],
    target: Output<'a>,
}

/// The output of the tiles and the terms added to it; each task writes its own rectangle.
struct Output<'a> {
    start: *mut f32,
    outputs: usize,
    /// Of weights in 8 bits.
    scales: Option<&'a [f32]>,
    bias: Option<&'a [f32]>,
    residual: Option<&'a [f32]>,
}

// SAFETY: no two tasks write the same element, and nothing reads before all are done.
unsafe impl Send for Output<'_> {}
// SAFETY: as above.
unsafe impl Sync for Output<'_> {}

impl<W: Stored> Product<'_, W> {
    fn run(&self, vectors: Vectors, count: usize) {
        if count == 0 {
            return;
        }
        let panels = self.target.outputs.div_ceil(PANEL);
        let blocks = count.div_ceil(TASK_ROWS);
        let work = count * self.inputs * panels * PANEL;
        let tasks_max = (work / TASK_WORK_MIN).clamp(1, 4 * rayon::current_num_threads());
        let splits = tasks_max.div_ceil(blocks).min(panels);
        let task = |index: usize| {
            let (block, split) = (index / splits, index % splits);
            let rows = even_part(count, blocks, block);
            let panels = even_part(panels, splits, split);
            tile::multiply(vectors, self, rows, panels);
        };
        if blocks * splits == 1 {
            task(0);
        } else {
            (0..blocks * splits).into_par_iter().for_each(task);
        }
    }

    /// Number of inputs per row.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// The weights of one panel: for each input, sixteen outputs.
    #[inline(always)]
    pub fn panel(&self, panel: usize) -> &[W] {
        &self.panels[panel * PANEL * self.inputs..(panel + 1) * PANEL * self.inputs]
    }

    /// The given rows.
    #[inline(always)]
    pub fn rows(&self, rows: Range<usize>) -> &[f32] {
        &self.rows[rows.start * self.inputs..rows.end * self.inputs]
    }

    /// Stores the sums of one row in one panel, plus bias and residual.
    #[inline(always)]
    pub fn store(&self, row: usize, panel: usize, mut sums: [f32; PANEL]) {
        let Output { start, outputs, scales, bias, residual } = self.target;
        let column = panel * PANEL;
        let width = PANEL.min(outputs - column);
        if let Some(scales) = scales {
            for (sum, scale) in sums.iter_mut().zip(&scales[column..column + width]) {
                *sum *= scale;
            }
        }
        if let Some(bias) = bias {
            for (sum, bias) in sums.iter_mut().zip(&bias[column..column + width]) {
                *sum += bias;
            }
        }
        let at = row * outputs + column;
        if let Some(residual) = residual {
            for (sum, residual) in sums.iter_mut().zip(&residual[at..at + width]) {
                *sum += residual;
            }
        }
        // SAFETY: `at + width` lies within the row, and only this task writes this rectangle.
        unsafe { std::ptr::copy_nonoverlapping(sums.as_ptr(), start.add(at), width) };
    }
}

/// Part number `index` of `parts` nearly equal parts of `0..length`.
#[inline(always)]
pub fn even_part(length: usize, parts: usize, index: usize) -> Range<usize> {
    index * length / parts..(index + 1) * length / parts
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(count: usize, seed: u64) -> Vec<f32> {
        let mut state = seed;
        (0..count)
            .map(|_| {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (state >> 40) as f32 / (1 << 23) as f32 - 1.0
            })
            .collect()
    }

    #[test]
    fn products_equal_reference_sums_for_every_shape() {
        let shapes = [(1, 3, 5), (7, 64, 16), (8, 20, 47), (9, 5, 16), (10, 7, 64), (13, 33, 50)];
        for (count, inputs, outputs) in shapes.into_iter().chain([(200, 48, 130)]) {
            let (weight, rows) = (numbers(outputs * inputs, 1), numbers(count * inputs, 2));
            let (bias, residual) = (numbers(outputs, 3), numbers(count * outputs, 4));
            let short: Vec<f32> =
                weight.iter().map(|&value| bf16::from_f32(value).to_f32()).collect();
            let stored = [(weight, 4), (short, 2)];
            for ((weight, bytes), vectors) in stored
                .iter()
                .flat_map(|one| Vectors::all().into_iter().map(move |kind| (one, kind)))
            {
                let packed = PackedWeight::pack(weight, outputs, inputs, WeightFormat::Exact);
                assert_eq!(packed.bytes(), outputs.div_ceil(PANEL) * PANEL * inputs * bytes);
                let got = packed.multiply_with(vectors, &rows, Some(&bias), Some(&residual));
                for row in 0..count {
                    for output in 0..outputs {
                        let mut sum = 0.0f32;
                        for input in 0..inputs {
                            sum = rows[row * inputs + input]
                                .mul_add(weight[output * inputs + input], sum);
                        }
                        let at = row * outputs + output;
                        assert_eq!(got[at], sum + bias[output] + residual[at], "{count} rows");
                    }
                }
            }
        }
    }

    #[test]
    fn products_of_eight_bits_equal_sums_of_the_rounded_weights() {
        for (count, inputs, outputs) in [(1, 3, 5), (7, 64, 16), (13, 33, 50)] {
            let (weight, rows) = (numbers(outputs * inputs, 1), numbers(count * inputs, 2));
            let packed = PackedWeight::pack(&weight, outputs, inputs, WeightFormat::Eight);
            assert_eq!(packed.bytes(), outputs.div_ceil(PANEL) * PANEL * inputs + 4 * outputs);
            for vectors in Vectors::all() {
                let got = packed.multiply_with(vectors, &rows, None, None);
                for (at, got) in got.into_iter().enumerate() {
                    let (row, output) = (at / outputs, at % outputs);
                    let weight = &weight[output * inputs..(output + 1) * inputs];
                    let scale = scale_of(weight);
                    let mut sum = 0.0f32;
                    for (value, weight) in rows[row * inputs..].iter().zip(weight) {
                        let rounded = (weight / scale).round_ties_even();
                        assert!((weight - rounded * scale).abs() <= 0.501 * scale);
                        sum = value.mul_add(rounded, sum);
                    }
                    assert_eq!(got, sum * scale, "{vectors:?}");
                }
            }
        }
    }

    #[test]
    fn a_row_does_not_depend_on_other_rows() {
        let (inputs, outputs) = (300, 200);
        let weight = numbers(outputs * inputs, 5);
        let packed = PackedWeight::pack(&weight, outputs, inputs, WeightFormat::Exact);
        let rows = numbers(250 * inputs, 6);
        let all = packed.multiply(&rows, None, None);
        for row in [0, 5, 96, 249] {
            let alone = packed.multiply(&rows[row * inputs..(row + 1) * inputs], None, None);
            assert_eq!(alone, all[row * outputs..(row + 1) * outputs]);
        }
    }
}
