//! How many sessions the memory holds: the bound on keys and values, `--kv-cache`.

use anyhow::{Result, ensure};
use vla::{DeviceName, Vla};

use super::WrongUsage;

/// Share of the free memory for keys and values; the rest is for activations and other programs.
const SHARE: f64 = 0.75;

/// Where the bound comes from.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Bound {
    Given(f64),
    Free(f64),
}

/// The number of sessions, at most `wanted`, whose keys and values fit into `given` gigabytes or
/// into the free memory. A lowered number is printed on standard error.
pub fn sessions(
    policy: &Vla,
    device: DeviceName,
    given: Option<f64>,
    wanted: u16,
    candidates: u32,
) -> Result<u16> {
    let (sessions, line) = lowered(policy, device, given, wanted, candidates)?;
    if let Some(line) = line {
        eprintln!("{line}");
    }
    Ok(sessions)
}

/// The most candidates that a session may have, up to `most`: `own`, if more would lower the number of sessions.
pub fn candidates(
    policy: &Vla,
    device: DeviceName,
    given: Option<f64>,
    wanted: u16,
    (own, most): (u32, u32),
) -> u32 {
    let fits = |candidates| {
        lowered(policy, device, given, wanted, candidates)
            .is_ok_and(|(sessions, _)| sessions == wanted)
    };
    if most > own && fits(most) { most } else { own }
}

/// The number of sessions, and a line if it is smaller than `wanted`.
fn lowered(
    policy: &Vla,
    device: DeviceName,
    given: Option<f64>,
    wanted: u16,
    candidates: u32,
) -> Result<(u16, Option<String>)> {
    let bound = match given {
        Some(gigabytes) => Bound::Given(gigabytes * 1e9),
        None => match free_bytes(device) {
            Some(free) => Bound::Free(free),
            None => return Ok((wanted, None)),
        },
    };
    fitting(bound, policy.cache_bytes(candidates as usize)? as f64, wanted, candidates)
}

/// As [`lowered`], for a session of `each` bytes.
fn fitting(bound: Bound, each: f64, wanted: u16, candidates: u32) -> Result<(u16, Option<String>)> {
    let (bytes, source) = match bound {
        Bound::Given(bytes) => (bytes, "--kv-cache".to_owned()),
        Bound::Free(free) => (free * SHARE, format!("{:.0} % of the free memory", 100.0 * SHARE)),
    };
    let fit = (bytes / each).floor();
    if fit >= f64::from(wanted) {
        return Ok((wanted, None));
    }
    let (need, room) = (each / 1e9, bytes / 1e9);
    let is_given = matches!(bound, Bound::Given(_));
    ensure!(
        fit >= 1.0 || !is_given,
        WrongUsage(format!(
            "--kv-cache: expected at least {need:.2} GB, which one session with {candidates} candidates takes, got \
             {room:.2}"
        ))
    );
    // A prediction of what is free must not stop a run that may fit.
    let sessions = fit.max(1.0) as u16;
    let line = format!(
        "sessions: {sessions} instead of {wanted}: keys and values of one with {candidates} candidates take {need:.2} GB, \
         and {source} is {room:.2} GB"
    );
    Ok((sessions, Some(line)))
}

/// Free bytes of the device's memory, if they are known.
fn free_bytes(device: DeviceName) -> Option<f64> {
    match device {
        DeviceName::Cpu => {
            let text = std::fs::read_to_string("/proc/meminfo").ok()?;
            let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
            Some(line.trim().strip_suffix("kB")?.trim().parse::<f64>().ok()? * 1024.0)
        }
        DeviceName::Cuda(index) => {
            let mut program = std::process::Command::new("nvidia-smi");
            program.args(["--query-gpu=memory.free", "--format=csv,noheader,nounits"]);
            let output = program.arg(format!("--id={index}")).output().ok()?;
            let mebibytes: f64 = String::from_utf8(output.stdout).ok()?.trim().parse().ok()?;
            Some(mebibytes * 1024.0 * 1024.0)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sessions_are_lowered_to_what_fits_and_that_is_said() {
        let fit = |bound, each| fitting(bound, each, 16, 5).expect("they fit");
        assert_eq!(fit(Bound::Free(30e9), 1e9), (16, None));
        let (sessions, line) = fit(Bound::Free(10e9), 1.6e9);
        assert_eq!(sessions, 4);
        let expected = "sessions: 4 instead of 16: keys and values of one with 5 candidates take 1.60 GB, and 75 % of the \
                        free memory is 7.50 GB";
        assert_eq!(line.as_deref(), Some(expected));
        assert_eq!(fit(Bound::Given(3.3e9), 1.6e9).0, 2);
        assert_eq!(fit(Bound::Free(1e9), 1.6e9).0, 1, "an estimate stops nothing");
        let error = fitting(Bound::Given(1e9), 1.6e9, 16, 5).expect_err("too little");
        let expected = "--kv-cache: expected at least 1.60 GB, which one session with 5 candidates takes, got 1.00";
        assert_eq!(error.to_string(), expected);
    }

    #[test]
    fn free_memory_is_known_on_linux() {
        assert!(free_bytes(DeviceName::Cpu).is_some_and(|free| free > 1e6));
    }
}
