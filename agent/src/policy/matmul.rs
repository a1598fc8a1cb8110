//! The product of activation rows with a packed weight; a row's bits do not depend on other rows.
//!
//! Every output is one chain of fused multiply-adds over the inputs in order, whatever tile
//! computes it. So one row, sixteen sessions and any number of threads give the same bits.

use std::ops::Range;

use rayon::prelude::*;

use super::backend::vectorised;

/// Outputs per panel: two vectors of eight, or one of sixteen.
const PANEL: usize = 16;
/// Rows per tile: 6 x 16 accumulators fill twelve of AVX2's sixteen vector registers.
const TILE: usize = 6;
/// Panels per tile with AVX-512: twelve accumulators again, and each weight read once for six rows.
const WIDE_PANELS: usize = 2;
/// Rows per task: with 256 inputs they stay in the second-level cache while panels stream by.
const TASK_ROWS: usize = 96;
/// Multiply-adds per task below which another thread costs more than it brings.
const TASK_WORK_MIN: usize = 1 << 17;

/// A weight of `outputs` x `inputs` stored in panels of sixteen outputs, input by input.
pub struct PackedWeight {
    outputs: usize,
    inputs: usize,
    panels: Vec<f32>,
}

impl PackedWeight {
    /// Packs a row-major weight as checkpoints store it: one row per output.
    pub fn pack(weight: &[f32], outputs: usize, inputs: usize) -> PackedWeight {
        assert_eq!(weight.len(), outputs * inputs, "weight of {outputs} x {inputs}");
        let mut panels = vec![0.0; outputs.div_ceil(PANEL) * PANEL * inputs];
        for (output, row) in weight.chunks_exact(inputs).enumerate() {
            let panel = &mut panels[output / PANEL * PANEL * inputs..];
            for (input, &value) in row.iter().enumerate() {
                panel[input * PANEL + output % PANEL] = value;
            }
        }
        PackedWeight { outputs, inputs, panels }
    }

    /// Outputs per row.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Bytes of the panels.
    pub fn bytes(&self) -> usize {
        size_of_val(self.panels.as_slice())
    }

    /// `rows` x weight + `bias` + `residual`, row-major.
    pub fn multiply(
        &self,
        rows: &[f32],
        bias: Option<&[f32]>,
        residual: Option<&[f32]>,
    ) -> Vec<f32> {
        let count = rows.len() / self.inputs;
        assert_eq!(rows.len(), count * self.inputs, "rows of {} inputs", self.inputs);
        let length = count * self.outputs;
        assert!(bias.is_none_or(|bias| bias.len() == self.outputs));
        assert!(residual.is_none_or(|residual| residual.len() == length));
        let mut output: Vec<f32> = Vec::with_capacity(length);
        let product =
            Product { weight: self, rows, bias, residual, output: Output(output.as_mut_ptr()) };
        product.run(count);
        // SAFETY: the tasks of `run` cover every row and every panel, so all numbers are written.
        unsafe { output.set_len(length) };
        output
    }
}

/// One product under way.
struct Product<'a> {
    weight: &'a PackedWeight,
    rows: &'a [f32],
    bias: Option<&'a [f32]>,
    residual: Option<&'a [f32]>,
    output: Output,
}

/// Where tiles are written; tasks own disjoint rectangles of it.
#[derive(Clone, Copy)]
struct Output(*mut f32);

// SAFETY: no two tasks write the same number, and nobody reads before all are done.
unsafe impl Send for Output {}
// SAFETY: as above.
unsafe impl Sync for Output {}

impl Product<'_> {
    fn run(&self, count: usize) {
        if count == 0 {
            return;
        }
        let panels = self.weight.outputs.div_ceil(PANEL);
        let blocks = count.div_ceil(TASK_ROWS);
        let work = count * self.weight.inputs * panels * PANEL;
        let tasks_max = (work / TASK_WORK_MIN).clamp(1, 4 * rayon::current_num_threads());
        let splits = tasks_max.div_ceil(blocks).min(panels);
        let task = |index: usize| {
            let (block, split) = (index / splits, index % splits);
            let rows = even_part(count, blocks, block);
            let panels = even_part(panels, splits, split);
            multiply_rectangle(self, rows, panels);
        };
        if blocks * splits == 1 {
            task(0);
        } else {
            (0..blocks * splits).into_par_iter().for_each(task);
        }
    }

    /// All tiles of some rows and some panels.
    #[inline(always)]
    fn rectangle(&self, rows: Range<usize>, panels: Range<usize>) {
        for panel in panels {
            for part in tiles(rows.clone()) {
                match part.len() {
                    1 => self.tile::<1>(part.start, panel),
                    2 => self.tile::<2>(part.start, panel),
                    3 => self.tile::<3>(part.start, panel),
                    4 => self.tile::<4>(part.start, panel),
                    5 => self.tile::<5>(part.start, panel),
                    6 => self.tile::<6>(part.start, panel),
                    other => unreachable!("a tile has 1 to {TILE} rows, got {other}"),
                }
            }
        }
    }

    #[inline(always)]
    fn tile<const ROWS: usize>(&self, first: usize, panel: usize) {
        let inputs = self.weight.inputs;
        let weights = &self.weight.panels[panel * PANEL * inputs..(panel + 1) * PANEL * inputs];
        let rows: [&[f32]; ROWS] = std::array::from_fn(|row| self.row(first + row));
        let mut sums = [[0.0f32; PANEL]; ROWS];
        for (input, weights) in weights.chunks_exact(PANEL).enumerate() {
            for row in 0..ROWS {
                // SAFETY: a row has as many inputs as the panel has chunks.
                let value = unsafe { *rows[row].get_unchecked(input) };
                for column in 0..PANEL {
                    sums[row][column] = value.mul_add(weights[column], sums[row][column]);
                }
            }
        }
        for (row, sums) in sums.iter().enumerate() {
            self.store(first + row, panel, sums);
        }
    }

    /// As [`rectangle`](Self::rectangle), two panels at a time.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f")]
    fn rectangle_wide(&self, rows: Range<usize>, panels: Range<usize>) {
        let mut panel = panels.start;
        while panel < panels.end {
            let count = WIDE_PANELS.min(panels.end - panel);
            for part in tiles(rows.clone()) {
                match (part.len(), count) {
                    (1, 2) => self.tile_wide::<1, 2>(part.start, panel),
                    (2, 2) => self.tile_wide::<2, 2>(part.start, panel),
                    (3, 2) => self.tile_wide::<3, 2>(part.start, panel),
                    (4, 2) => self.tile_wide::<4, 2>(part.start, panel),
                    (5, 2) => self.tile_wide::<5, 2>(part.start, panel),
                    (6, 2) => self.tile_wide::<6, 2>(part.start, panel),
                    // The last of an odd number of panels, row by row: too seldom to matter.
                    _ => part.for_each(|row| self.tile_wide::<1, 1>(row, panel)),
                }
            }
            panel += count;
        }
    }

    /// Written with intrinsics: left to the compiler, some tile sizes become scalar code.
    #[cfg(target_arch = "x86_64")]
    #[inline]
    #[target_feature(enable = "avx512f")]
    fn tile_wide<const ROWS: usize, const PANELS: usize>(&self, first: usize, panel: usize) {
        use std::arch::x86_64::{
            _mm512_fmadd_ps, _mm512_loadu_ps, _mm512_set1_ps, _mm512_setzero_ps, _mm512_storeu_ps,
        };
        let inputs = self.weight.inputs;
        let weights: [&[f32]; PANELS] = std::array::from_fn(|index| {
            let start = (panel + index) * PANEL * inputs;
            &self.weight.panels[start..start + PANEL * inputs]
        });
        let rows: [&[f32]; ROWS] = std::array::from_fn(|row| self.row(first + row));
        let mut sums = [[_mm512_setzero_ps(); PANELS]; ROWS];
        for input in 0..inputs {
            for index in 0..PANELS {
                // SAFETY: a panel has `inputs` chunks of sixteen.
                let weight = unsafe { _mm512_loadu_ps(weights[index].as_ptr().add(input * PANEL)) };
                for row in 0..ROWS {
                    // SAFETY: a row has `inputs` numbers.
                    let value = _mm512_set1_ps(unsafe { *rows[row].get_unchecked(input) });
                    sums[row][index] = _mm512_fmadd_ps(value, weight, sums[row][index]);
                }
            }
        }
        for (row, sums) in sums.iter().enumerate() {
            for (index, &sum) in sums.iter().enumerate() {
                let mut numbers = [0.0f32; PANEL];
                // SAFETY: sixteen numbers have room there.
                unsafe { _mm512_storeu_ps(numbers.as_mut_ptr(), sum) };
                self.store(first + row, panel + index, &numbers);
            }
        }
    }

    #[inline(always)]
    fn row(&self, row: usize) -> &[f32] {
        &self.rows[row * self.weight.inputs..(row + 1) * self.weight.inputs]
    }

    #[inline(always)]
    fn store(&self, row: usize, panel: usize, sums: &[f32; PANEL]) {
        let outputs = self.weight.outputs;
        let column = panel * PANEL;
        let width = PANEL.min(outputs - column);
        let mut sums = *sums;
        if let Some(bias) = self.bias {
            for (sum, bias) in sums.iter_mut().zip(&bias[column..column + width]) {
                *sum += bias;
            }
        }
        let start = row * outputs + column;
        if let Some(residual) = self.residual {
            for (sum, residual) in sums.iter_mut().zip(&residual[start..start + width]) {
                *sum += residual;
            }
        }
        // SAFETY: `start + width` lies within the row, and this task alone owns the rectangle.
        unsafe { std::ptr::copy_nonoverlapping(sums.as_ptr(), self.output.0.add(start), width) };
    }
}

fn multiply_rectangle(product: &Product<'_>, rows: Range<usize>, panels: Range<usize>) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512f") {
        // SAFETY: the feature was detected on this processor.
        return unsafe { product.rectangle_wide(rows, panels) };
    }
    multiply_rectangle_fast(product, rows, panels);
}

vectorised! {
    fn multiply_rectangle_fast(product: &Product<'_>, rows: Range<usize>, panels: Range<usize>)
        = Product::rectangle;
}

/// Rows in nearly equal parts of at most [`TILE`].
#[inline(always)]
fn tiles(rows: Range<usize>) -> impl Iterator<Item = Range<usize>> {
    let count = rows.len().div_ceil(TILE);
    (0..count).map(move |index| {
        let part = even_part(rows.len(), count, index);
        rows.start + part.start..rows.start + part.end
    })
}

/// The `index`th of `parts` nearly equal parts of `0..length`.
#[inline(always)]
fn even_part(length: usize, parts: usize, index: usize) -> Range<usize> {
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
    fn products_equal_plain_sums_at_every_shape() {
        for (count, inputs, outputs) in [(1, 3, 5), (7, 64, 16), (13, 33, 50), (200, 48, 130)] {
            let (weight, rows) = (numbers(outputs * inputs, 1), numbers(count * inputs, 2));
            let (bias, residual) = (numbers(outputs, 3), numbers(count * outputs, 4));
            let packed = PackedWeight::pack(&weight, outputs, inputs);
            let got = packed.multiply(&rows, Some(&bias), Some(&residual));
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

    #[test]
    fn a_row_does_not_depend_on_its_neighbours() {
        let (inputs, outputs) = (300, 200);
        let packed = PackedWeight::pack(&numbers(outputs * inputs, 5), outputs, inputs);
        let rows = numbers(250 * inputs, 6);
        let all = packed.multiply(&rows, None, None);
        for row in [0, 5, 96, 249] {
            let alone = packed.multiply(&rows[row * inputs..(row + 1) * inputs], None, None);
            assert_eq!(alone, all[row * outputs..(row + 1) * outputs]);
        }
    }
}
