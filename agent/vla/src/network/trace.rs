//! Records the outputs of layers by name, for parity tests and inspection.

use candle_core::{Result, Tensor};

/// Records outputs, or nothing at no cost.
#[derive(Default)]
pub struct Trace {
    outputs: Option<Vec<(String, Tensor)>>,
}

impl Trace {
    /// A trace that records nothing.
    pub fn off() -> Trace {
        Trace { outputs: None }
    }

    /// A trace that records everything.
    pub fn on() -> Trace {
        Trace { outputs: Some(Vec::new()) }
    }

    /// Records a layer's output under the checkpoint's name of that layer.
    pub fn record(&mut self, name: impl FnOnce() -> String, output: &Tensor) {
        if let Some(outputs) = &mut self.outputs {
            outputs.push((name(), output.clone()));
        }
    }

    /// All recorded outputs, in the order of computation.
    pub fn into_outputs(self) -> Result<Vec<(String, Tensor)>> {
        match self.outputs {
            Some(outputs) => Ok(outputs),
            None => candle_core::bail!("trace: recording is off"),
        }
    }
}
