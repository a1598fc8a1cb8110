//! A policy server as the policy: its arguments, and the settings that it can do.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use clap::Args;
use decision::{Policy, PolicyInfo, Setting};
use remote_policy::{Address, ClientOptions, RemotePolicy};
use runtime::servers::Host;
use serde_json::{Value, json};

use super::WrongUsage;
use super::policy::LoadedPolicy;
use super::recorded_policy::ServedPolicy;

/// The environment variable with a policy server's key.
const KEY_VARIABLE: &str = "REVER_POLICY_KEY";
/// The largest file that is read as a key.
const KEY_BYTES_MAX: u64 = 4096;

/// How a policy server is used.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Policy and verifier")]
pub struct ServerArguments {
    /// How observations and actions of a policy server are mapped: bridge, libero, rever, simpler, or a file
    /// [default: rever for a server of rever, simpler for vla-eval, otherwise bridge]
    #[arg(long, value_name = "NAME|FILE")]
    pub policy_profile: Option<String>,
    /// Key of a policy server, sent as `Authorization: Api-Key KEY` [default: the variable REVER_POLICY_KEY, if set]
    #[arg(long, value_name = "FILE")]
    pub policy_key_file: Option<PathBuf>,
}

impl ServerArguments {
    /// Connects to the server at an address.
    pub fn connect(&self, address: &str, host: &Host) -> Result<LoadedPolicy> {
        let connect = || -> Result<RemotePolicy> {
            let address: Address = address.parse().context("--policy")?;
            let options =
                ClientOptions { profile: self.policy_profile.clone(), key: self.key(host)? };
            RemotePolicy::connect(address, options)
        };
        let server = connect().map_err(|error| WrongUsage(format!("{error:#}")))?;
        let server = Arc::new(server);
        Ok(LoadedPolicy {
            policy: Arc::clone(&server) as Arc<dyn Policy>,
            checkpoint: None,
            folder: None,
            name: address.to_owned(),
            backbone: None,
            server: Some(server),
        })
    }

    /// Refuses the options of a server for a checkpoint.
    pub fn ensure_unused(&self) -> Result<()> {
        for (option, is_given) in [
            ("--policy-profile", self.policy_profile.is_some()),
            ("--policy-key-file", self.policy_key_file.is_some()),
        ] {
            if is_given {
                return Err(WrongUsage(format!(
                    "{option}: expected a policy server (--policy openpi://HOST:PORT, vla-eval://HOST:PORT or \
                     http://HOST:PORT/act), got a checkpoint"
                ))
                .into());
            }
        }
        Ok(())
    }

    /// The options as they are typed, with a space before each.
    pub fn words(&self) -> String {
        let profile = self.policy_profile.iter().map(|name| format!(" --policy-profile {name}"));
        let key = self.policy_key_file.iter();
        let key = key.map(|file| format!(" --policy-key-file {}", file.display()));
        profile.chain(key).collect()
    }

    fn key(&self, host: &Host) -> Result<Option<String>> {
        match &self.policy_key_file {
            Some(file) => {
                let key = read_key(file);
                key.map(Some).with_context(|| format!("--policy-key-file {}", file.display()))
            }
            None => {
                let key = host.variables.get(std::ffi::OsStr::new(KEY_VARIABLE));
                let key = key.filter(|key| !key.is_empty()).map(|key| key.to_str());
                key.map(|key| key.context("expected UTF-8").and_then(checked))
                    .transpose()
                    .context(KEY_VARIABLE)
            }
        }
    }
}

/// Reads the key in a file.
pub fn read_key(file: &Path) -> Result<String> {
    let mut key = String::new();
    let bytes = File::open(file)?.take(KEY_BYTES_MAX + 1).read_to_string(&mut key)?;
    ensure!(bytes as u64 <= KEY_BYTES_MAX, "expected at most {KEY_BYTES_MAX} bytes, got more");
    checked(&key)
}

fn checked(key: &str) -> Result<String> {
    let key = key.trim();
    let is_plain = !key.is_empty() && key.bytes().all(|byte| byte.is_ascii_graphic());
    ensure!(is_plain, "expected a key of printable ASCII without spaces");
    Ok(key.to_owned())
}

/// The settings that a policy can do. One that it cannot do is wrong usage, or skipped if it is a default.
pub fn possible(
    policy: &dyn Policy,
    settings: &[Setting],
    is_default: bool,
) -> Result<Vec<Setting>> {
    let mut possible = Vec::new();
    for setting in settings {
        match policy.check(setting) {
            Ok(()) => possible.push(*setting),
            Err(error) if is_default => eprintln!("skipping {error:#}"),
            Err(error) => return Err(WrongUsage(format!("{error:#}")).into()),
        }
    }
    Ok(possible)
}

/// What determines a run's results beside the policy's digest, for the header.
pub fn header(server: &RemotePolicy) -> Result<Value> {
    Ok(json!({
        "wire": server.address().wire.scheme(),
        "profile": server.profile_name(),
        "profile_digest": server.profile_digest()?,
    }))
}

/// What the candidates of a run are read with.
pub fn served(policy: &dyn Policy, backbone: Option<&Path>) -> ServedPolicy {
    let PolicyInfo { hidden_size, action_space, .. } = policy.info();
    let backbone = backbone.map(|backbone| backbone.display().to_string());
    ServedPolicy { hidden_size: *hidden_size, action_space: action_space.clone(), backbone }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_comes_from_a_file_or_the_environment() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("key");
        std::fs::write(&file, "secret\n").expect("written");
        let variables = [(KEY_VARIABLE.into(), "other".into())];
        let host = Host { variables: variables.into(), ..Host::default() };
        let of_file =
            ServerArguments { policy_key_file: Some(file.clone()), ..ServerArguments::default() };
        assert_eq!(of_file.key(&host).expect("a key").as_deref(), Some("secret"));
        let of_variable = ServerArguments::default();
        assert_eq!(of_variable.key(&host).expect("a key").as_deref(), Some("other"));
        assert_eq!(of_variable.key(&Host::default()).expect("no key"), None);
        std::fs::write(&file, "two words").expect("written");
        let error = format!("{:#}", of_file.key(&host).expect_err("refused"));
        assert!(error.ends_with("expected a key of printable ASCII without spaces"), "{error}");
    }
}
