//! A linear layer: rows (n, inputs) -> rows (n, outputs), with an optional bias.

use candle_core::{Result, Tensor};

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
    /// Makes a layer from a weight of (outputs, inputs), the layout of checkpoints.
    pub fn new(weight: &Tensor, bias: Option<Tensor>, backend: Backend) -> Result<Linear> {
        let weight = weight.contiguous()?;
        let form = match backend {
            Backend::Kernels => {
                let (outputs, inputs) = weight.dims2()?;
                Form::Packed(PackedWeight::pack(&Values::of(&weight)?, outputs, inputs))
            }
            Backend::Tensors => Form::Tensor(weight),
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
                let mut output = rows.matmul(&weight.t()?)?;
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
