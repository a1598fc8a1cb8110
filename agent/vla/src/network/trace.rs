//! Outputs of layers by name, kept on request: for proofs of parity and for looking inside.

use candle_core::{Result, Tensor};

/// Collects outputs, or nothing at no cost.
#[derive(Default)]
pub struct Trace {
    outputs: Option<Vec<(String, Tensor)>>,
}

impl Trace {
    /// A trace that keeps nothing.
    pub fn off() -> Trace {
        Trace { outputs: None }
    }

    /// A trace that keeps everything.
    pub fn on() -> Trace {
        Trace { outputs: Some(Vec::new()) }
    }

    /// Keeps a layer's output under the checkpoint's name of that layer.
    pub fn record(&mut self, name: impl FnOnce() -> String, output: &Tensor) {
        if let Some(outputs) = &mut self.outputs {
            outputs.push((name(), output.clone()));
        }
    }

    /// Everything kept, in the order of computation.
    pub fn into_outputs(self) -> Result<Vec<(String, Tensor)>> {
        match self.outputs {
            Some(outputs) => Ok(outputs),
            None => candle_core::bail!("trace: expected one that was on"),
        }
    }
}
