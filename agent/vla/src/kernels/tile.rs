//! The innermost loops of a product: up to six rows times a panel of sixteen outputs.
//!
//! They use intrinsics, with one function per number of rows. The compiler alone generates scalar
//! code for some sizes and keeps the sums in memory for others.

use std::ops::Range;

use half::bf16;

use crate::kernels::matmul::{Product, even_part};

#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::{
    __m256, __m512, _mm_loadl_epi64, _mm_loadu_si128, _mm256_broadcast_ss, _mm256_castsi256_ps,
    _mm256_cvtepi8_epi32, _mm256_cvtepi32_ps, _mm256_cvtepu16_epi32, _mm256_fmadd_ps,
    _mm256_loadu_ps, _mm256_loadu_si256, _mm256_setzero_ps, _mm256_slli_epi32, _mm256_storeu_ps,
    _mm512_castsi512_ps, _mm512_cvtepi8_epi32, _mm512_cvtepi32_ps, _mm512_cvtepu16_epi32,
    _mm512_fmadd_ps, _mm512_loadu_ps, _mm512_set1_ps, _mm512_setzero_ps, _mm512_slli_epi32,
    _mm512_storeu_ps,
};

/// Outputs per panel: two vectors of eight, or one of sixteen.
pub const PANEL: usize = 16;
/// Rows per tile: 6 x 16 sums fill twelve of AVX2's sixteen vector registers.
const ROWS_MAX: usize = 6;
/// Panels per tile with AVX-512: again twelve registers of sums, and each weight is read once for
/// six rows.
#[cfg(target_arch = "x86_64")]
const WIDE_PANELS: usize = 2;

/// The storage format of weights. With few rows, 16 bits halve the memory traffic that bounds a
/// step.
pub trait Stored: Copy + Send + Sync {
    /// The number as f32.
    fn widen(self) -> f32;

    /// Loads eight numbers.
    ///
    /// # Safety
    /// The processor supports AVX2, and `from` points to eight numbers.
    #[cfg(target_arch = "x86_64")]
    unsafe fn load_eight(from: *const Self) -> __m256;

    /// Loads sixteen numbers.
    ///
    /// # Safety
    /// The processor supports AVX-512, and `from` points to sixteen numbers.
    #[cfg(target_arch = "x86_64")]
    unsafe fn load_sixteen(from: *const Self) -> __m512;
}

impl Stored for f32 {
    fn widen(self) -> f32 {
        self
    }

    #[cfg(target_arch = "x86_64")]
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    unsafe fn load_eight(from: *const f32) -> __m256 {
        // SAFETY: the caller's promise.
        unsafe { _mm256_loadu_ps(from) }
    }

    #[cfg(target_arch = "x86_64")]
    #[inline]
    #[target_feature(enable = "avx512f")]
    unsafe fn load_sixteen(from: *const f32) -> __m512 {
        // SAFETY: the caller's promise.
        unsafe { _mm512_loadu_ps(from) }
    }
}

/// bf16 is the upper half of an f32.
impl Stored for bf16 {
    fn widen(self) -> f32 {
        self.to_f32()
    }

    #[cfg(target_arch = "x86_64")]
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    unsafe fn load_eight(from: *const bf16) -> __m256 {
        // SAFETY: the caller's promise.
        let halves = unsafe { _mm_loadu_si128(from.cast()) };
        _mm256_castsi256_ps(_mm256_slli_epi32::<16>(_mm256_cvtepu16_epi32(halves)))
    }

    #[cfg(target_arch = "x86_64")]
    #[inline]
    #[target_feature(enable = "avx512f")]
    unsafe fn load_sixteen(from: *const bf16) -> __m512 {
        // SAFETY: the caller's promise.
        let halves = unsafe { _mm256_loadu_si256(from.cast()) };
        _mm512_castsi512_ps(_mm512_slli_epi32::<16>(_mm512_cvtepu16_epi32(halves)))
    }
}

/// An integer; its output's scale is applied to the sum.
impl Stored for i8 {
    fn widen(self) -> f32 {
        f32::from(self)
    }

    #[cfg(target_arch = "x86_64")]
    #[inline]
    #[target_feature(enable = "avx2,fma")]
    unsafe fn load_eight(from: *const i8) -> __m256 {
        // SAFETY: the caller's promise.
        let bytes = unsafe { _mm_loadl_epi64(from.cast()) };
        _mm256_cvtepi32_ps(_mm256_cvtepi8_epi32(bytes))
    }

    #[cfg(target_arch = "x86_64")]
    #[inline]
    #[target_feature(enable = "avx512f")]
    unsafe fn load_sixteen(from: *const i8) -> __m512 {
        // SAFETY: the caller's promise.
        let bytes = unsafe { _mm_loadu_si128(from.cast()) };
        _mm512_cvtepi32_ps(_mm512_cvtepi8_epi32(bytes))
    }
}

/// A vector width that this processor supports.
#[derive(Clone, Copy, Debug)]
pub struct Vectors(Width);

#[derive(Clone, Copy, Debug)]
enum Width {
    #[cfg(target_arch = "x86_64")]
    Sixteen,
    #[cfg(target_arch = "x86_64")]
    Eight,
    /// Vectorised by the compiler.
    Plain,
}

impl Vectors {
    /// The widest vectors.
    pub fn widest() -> Vectors {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") {
                return Vectors(Width::Sixteen);
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                return Vectors(Width::Eight);
            }
        }
        Vectors(Width::Plain)
    }

    /// All supported vectors, for tests: the results must be bitwise equal.
    #[cfg(test)]
    pub fn all() -> Vec<Vectors> {
        let mut all = vec![Vectors(Width::Plain), Vectors::widest()];
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            all.push(Vectors(Width::Eight));
        }
        all
    }
}

/// Computes all tiles of the given rows and panels.
pub fn multiply<W: Stored>(
    vectors: Vectors,
    product: &Product<'_, W>,
    rows: Range<usize>,
    panels: Range<usize>,
) {
    match vectors.0 {
        // SAFETY: a value of this type exists only if the feature was detected.
        #[cfg(target_arch = "x86_64")]
        Width::Sixteen => unsafe { multiply_sixteen(product, rows, panels) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Width::Eight => unsafe { multiply_eight(product, rows, panels) },
        Width::Plain => multiply_plain(product, rows, panels),
    }
}

/// Calls a tile function with its number of rows as a constant.
macro_rules! with_rows {
    ($count:expr, $tile:ident $(, $panels:literal)?; $($argument:expr),*) => {
        match $count {
            1 => $tile::<W, 1 $(, $panels)?>($($argument),*),
            2 => $tile::<W, 2 $(, $panels)?>($($argument),*),
            3 => $tile::<W, 3 $(, $panels)?>($($argument),*),
            4 => $tile::<W, 4 $(, $panels)?>($($argument),*),
            5 => $tile::<W, 5 $(, $panels)?>($($argument),*),
            6 => $tile::<W, 6 $(, $panels)?>($($argument),*),
            other => unreachable!("a tile has 1 to {ROWS_MAX} rows, got {other}"),
        }
    };
}

fn multiply_plain<W: Stored>(product: &Product<'_, W>, rows: Range<usize>, panels: Range<usize>) {
    for panel in panels {
        for part in tiles(rows.clone()) {
            with_rows!(part.len(), tile_plain; product, part.start, panel);
        }
    }
}

fn tile_plain<W: Stored, const ROWS: usize>(product: &Product<'_, W>, first: usize, panel: usize) {
    let rows = product.rows(first..first + ROWS);
    let inputs = product.inputs();
    let mut sums = [[0.0f32; PANEL]; ROWS];
    for (input, weights) in product.panel(panel).chunks_exact(PANEL).enumerate() {
        for (row, sums) in sums.iter_mut().enumerate() {
            let value = rows[row * inputs + input];
            for (sum, weight) in sums.iter_mut().zip(weights) {
                *sum = value.mul_add(weight.widen(), *sum);
            }
        }
    }
    for (row, sums) in sums.into_iter().enumerate() {
        product.store(first + row, panel, sums);
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn multiply_eight<W: Stored>(product: &Product<'_, W>, rows: Range<usize>, panels: Range<usize>) {
    for panel in panels {
        for part in tiles(rows.clone()) {
            with_rows!(part.len(), tile_eight; product, part.start, panel);
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[inline]
#[target_feature(enable = "avx2,fma")]
fn tile_eight<W: Stored, const ROWS: usize>(product: &Product<'_, W>, first: usize, panel: usize) {
    let rows = product.rows(first..first + ROWS);
    let inputs = product.inputs();
    let weights = product.panel(panel);
    let mut sums = [[_mm256_setzero_ps(); 2]; ROWS];
    for input in 0..inputs {
        // SAFETY: a panel has `inputs` chunks of sixteen, and this function has AVX2.
        let (left, right) = unsafe {
            let weights = weights.as_ptr().add(input * PANEL);
            (W::load_eight(weights), W::load_eight(weights.add(PANEL / 2)))
        };
        for (row, sums) in sums.iter_mut().enumerate() {
            // SAFETY: `rows` has ROWS times `inputs` numbers.
            let value = _mm256_broadcast_ss(unsafe { rows.get_unchecked(row * inputs + input) });
            sums[0] = _mm256_fmadd_ps(value, left, sums[0]);
            sums[1] = _mm256_fmadd_ps(value, right, sums[1]);
        }
    }
    for (row, sums) in sums.into_iter().enumerate() {
        let mut numbers = [0.0f32; PANEL];
        // SAFETY: there is room for sixteen numbers.
        unsafe {
            _mm256_storeu_ps(numbers.as_mut_ptr(), sums[0]);
            _mm256_storeu_ps(numbers.as_mut_ptr().add(PANEL / 2), sums[1]);
        }
        product.store(first + row, panel, numbers);
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn multiply_sixteen<W: Stored>(product: &Product<'_, W>, rows: Range<usize>, panels: Range<usize>) {
    let mut panel = panels.start;
    while panel < panels.end {
        let count = WIDE_PANELS.min(panels.end - panel);
        for part in tiles(rows.clone()) {
            if count == WIDE_PANELS {
                with_rows!(part.len(), tile_sixteen, 2; product, part.start, panel);
            } else {
                // An odd number of panels: the last one is computed alone, which is rare.
                part.for_each(|row| tile_sixteen::<W, 1, 1>(product, row, panel));
            }
        }
        panel += count;
    }
}

#[cfg(target_arch = "x86_64")]
#[inline]
#[target_feature(enable = "avx512f")]
fn tile_sixteen<W: Stored, const ROWS: usize, const PANELS: usize>(
    product: &Product<'_, W>,
    first: usize,
    panel: usize,
) {
    let rows = product.rows(first..first + ROWS);
    let inputs = product.inputs();
    let weights: [&[W]; PANELS] = std::array::from_fn(|index| product.panel(panel + index));
    let mut sums = [[_mm512_setzero_ps(); PANELS]; ROWS];
    for input in 0..inputs {
        for (index, weights) in weights.iter().enumerate() {
            // SAFETY: a panel has `inputs` chunks of sixteen, and this function has AVX-512.
            let weight = unsafe { W::load_sixteen(weights.as_ptr().add(input * PANEL)) };
            for (row, sums) in sums.iter_mut().enumerate() {
                // SAFETY: `rows` has ROWS times `inputs` numbers.
                let value = _mm512_set1_ps(unsafe { *rows.get_unchecked(row * inputs + input) });
                sums[index] = _mm512_fmadd_ps(value, weight, sums[index]);
            }
        }
    }
    for (row, sums) in sums.into_iter().enumerate() {
        for (index, sum) in sums.into_iter().enumerate() {
            let mut numbers = [0.0f32; PANEL];
            // SAFETY: there is room for sixteen numbers.
            unsafe { _mm512_storeu_ps(numbers.as_mut_ptr(), sum) };
            product.store(first + row, panel + index, numbers);
        }
    }
}

/// Splits rows into nearly equal parts of at most [`ROWS_MAX`].
#[inline(always)]
fn tiles(rows: Range<usize>) -> impl Iterator<Item = Range<usize>> {
    let count = rows.len().div_ceil(ROWS_MAX);
    (0..count).map(move |index| {
        let part = even_part(rows.len(), count, index);
        rows.start + part.start..rows.start + part.end
    })
}
