//! A linear layer: rows (n, inputs) -> rows (n, outputs), with an optional bias.

use candle_core::{DType, Result, Tensor};

use crate::checkpoint::weights::Target;
use crate::kernels::backend::{Backend, Values};
use crate::kernels::matmul::PackedWeight;

/// A weight of (outputs, inputs) in the format of its backend.
pub struct Linear {
    form: Form,
    bias: Option<Tensor>,
}

enum Form {
    Packed(PackedWeight),
    Tensor(Tensor),
}

impl Linear {
    /// Makes a layer from a weight of (outputs, inputs), the layout of checkpoints, in the memory of
    /// the CPU.
    pub fn new(weight: &Tensor, bias: Option<Tensor>, target: &Target) -> Result<Linear> {
        let weight = weight.contiguous()?;
        let form = match target.backend {
            Backend::Kernels => {
                let (outputs, inputs) = weight.dims2()?;
                let values = Values::of(&weight)?;
                Form::Packed(PackedWeight::pack(&values, outputs, inputs, target.format))
            }
            Backend::Tensors(dtype) => {
                Form::Tensor(weight.to_dtype(dtype)?.to_device(&target.device)?)
            }
        };
        Ok(Linear { form, bias })
    }

    /// Size of the weight in bytes.
    pub fn bytes(&self) -> usize {
        match &self.form {
            Form::Packed(weight) => weight.bytes(),
            Form::Tensor(weight) => weight.elem_count() * weight.dtype().size_in_bytes(),
        }
    }

    /// `rows` x weight + bias.
    pub fn forward(&self, rows: &Tensor) -> Result<Tensor> {
        self.apply(rows, None)
    }

    /// `residual` + `rows` x weight + bias.
    pub fn forward_onto(&self, residual: &Tensor, rows: &Tensor) -> Result<Tensor> {
        self.apply(rows, Some(residual))
    }

    fn apply(&self, rows: &Tensor, residual: Option<&Tensor>) -> Result<Tensor> {
        match &self.form {
            Form::Packed(weight) => {
                let count = rows.dim(0)?;
                let bias = self.bias.as_ref().map(Values::of).transpose()?;
                let residual = residual.map(Values::of).transpose()?;
                let output =
                    weight.multiply(&Values::of(rows)?, bias.as_deref(), residual.as_deref());
                Tensor::from_vec(output, (count, weight.outputs()), rows.device())
            }
            Form::Tensor(weight) => {
                let rows = rows.to_dtype(weight.dtype())?;
                let mut output = rows.matmul(&weight.t()?)?.to_dtype(DType::F32)?;
                if let Some(bias) = &self.bias {
                    output = output.broadcast_add(bias)?;
                }
                match residual {
                    Some(residual) => residual + output,
                    None => Ok(output),
                }
            }
        }
    }
}
