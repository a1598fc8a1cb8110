//! The arithmetic backends: our kernels on CPU slices, or candle's operations on any device.

use std::ops::{Deref, Range};

use candle_core::{DType, Device, Result, Storage, StorageRef, Tensor, bail};

/// How layers compute; selected when weights are loaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Backend {
    /// Packed weights and fused loops over f32 slices. A row's bits do not depend on other rows.
    Kernels,
    /// candle's operations: for any device, and as the reference of the kernels' tests. Matrices,
    /// keys and values have this type; everything else is f32.
    Tensors(DType),
}

impl Backend {
    /// The faster backend of a device. On a GPU, matrices of 16 bits halve the memory: a 7B checkpoint
    /// takes 15 GB.
    pub fn for_device(device: &Device) -> Backend {
        if device.is_cpu() { Backend::Kernels } else { Backend::Tensors(DType::BF16) }
    }
}

/// The values of a contiguous f32 tensor on the CPU, as a slice.
pub struct Values<'a> {
    storage: StorageRef<'a>,
    range: Range<usize>,
}

impl<'a> Values<'a> {
    /// Locks the tensor's storage for reading.
    pub fn of(tensor: &'a Tensor) -> Result<Values<'a>> {
        let (storage, layout) = tensor.storage_and_layout();
        let Some((start, end)) = layout.contiguous_offsets() else {
            bail!("kernel input of shape {:?}: expected contiguous rows", tensor.shape());
        };
        match &*storage {
            Storage::Cpu(values) => {
                values.as_slice::<f32>()?;
            }
            _ => bail!("kernel input: expected a tensor on the cpu, got {:?}", tensor.device()),
        }
        Ok(Values { storage, range: start..end })
    }
}

impl Deref for Values<'_> {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        match &*self.storage {
            Storage::Cpu(values) => match values.as_slice::<f32>() {
                Ok(values) => &values[self.range.clone()],
                Err(_) => unreachable!("the type was checked when the storage was locked"),
            },
            _ => unreachable!("the device was checked when the storage was locked"),
        }
    }
}

/// Defines a function that runs another one compiled for AVX2 and fused multiply-add if the
/// processor supports them, and as it is otherwise.
///
/// The result is the same in both cases, because every sum uses `mul_add` in a fixed order. The
/// other function must be `#[inline(always)]`, otherwise it is not recompiled for these features
/// and every `mul_add` becomes a slow call. A closure cannot be marked so.
macro_rules! vectorised {
    (fn $name:ident($($argument:ident: $kind:ty),* $(,)?) $(-> $result:ty)? = $body:path;) => {
        fn $name($($argument: $kind),*) $(-> $result)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                fn wide($($argument: $kind),*) $(-> $result)? {
                    $body($($argument),*)
                }
                if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                    // SAFETY: both features were detected on this processor.
                    return unsafe { wide($($argument),*) };
                }
            }
            $body($($argument),*)
        }
    };
}

pub(crate) use vectorised;
