//! The device of a policy, named as on the command line.

use std::fmt;
use std::str::FromStr;

use anyhow::{Context as _, Result, ensure};
use candle_core::Device;

/// `cpu`, `cuda` (the first GPU) or `cuda:N`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DeviceName {
    /// The CPU.
    #[default]
    Cpu,
    /// A GPU, numbered from 0; only in a program built with the feature `cuda`.
    Cuda(usize),
}

impl DeviceName {
    /// Opens the device. The error for a missing feature says how to build with it.
    pub fn open(self) -> Result<Device> {
        let DeviceName::Cuda(index) = self else { return Ok(Device::Cpu) };
        ensure!(
            cfg!(feature = "cuda"),
            "device {self}: this build of rever supports only cpu; rebuild it with `cargo build --release --features cuda`"
        );
        Device::new_cuda(index).with_context(|| format!("cannot open the device {self}"))
    }
}

impl FromStr for DeviceName {
    type Err = String;

    fn from_str(text: &str) -> Result<DeviceName, String> {
        let unknown = || format!("expected cpu, cuda or cuda:N, got {text}");
        match text.split_once(':') {
            None if text == "cpu" => Ok(DeviceName::Cpu),
            None if text == "cuda" => Ok(DeviceName::Cuda(0)),
            Some(("cuda", index)) => index.parse().map(DeviceName::Cuda).map_err(|_| unknown()),
            _ => Err(unknown()),
        }
    }
}

impl fmt::Display for DeviceName {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            DeviceName::Cpu => formatter.write_str("cpu"),
            DeviceName::Cuda(index) => write!(formatter, "cuda:{index}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_strictly() {
        assert_eq!("cpu".parse(), Ok(DeviceName::Cpu));
        assert_eq!("cuda".parse(), Ok(DeviceName::Cuda(0)));
        assert_eq!("cuda:3".parse(), Ok(DeviceName::Cuda(3)));
        for wrong in ["", "gpu", "CUDA", "cuda:", "cuda:-1", "cpu:0"] {
            let error = wrong.parse::<DeviceName>().expect_err(wrong);
            assert_eq!(error, format!("expected cpu, cuda or cuda:N, got {wrong}"));
        }
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_build_without_cuda_says_how_to_enable_it() {
        let error = DeviceName::Cuda(1).open().expect_err("no such device");
        let text = format!("{error:#}");
        assert!(text.contains("cuda:1") && text.contains("--features cuda"), "{text}");
    }
}
