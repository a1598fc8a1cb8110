//! `rever serve-policy`: the agent as a policy server for the harnesses of others.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};
use clap::{Args, ValueEnum};
use decision::{Scorer, Setting, Strategy};
use remote_policy::server::{
    ActionForm, AgentOptions, ApiKey, CANDIDATES_MAX, Gripper, ObservationKeys, Rotation,
    ServedAgent, ServerOptions, serve,
};
use runtime::servers::Host;
use tokio::net::TcpListener;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::watch;
use vla::Vla;

use super::evaluate::temperature;
use super::names::StrategyParser;
use super::policy::PolicyArguments;
use super::{Output, WrongUsage, cache, policy_server};

/// Serve the verified agent to vla-eval, to openpi's clients and as OpenVLA's /act, on one port
#[derive(Debug, Args)]
#[command(next_help_heading = "Server")]
pub struct Arguments {
    /// Listen here; HOST:0 chooses a port
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:8000")]
    listen: SocketAddr,
    /// Clients must send the key in this file, as `Authorization: Api-Key KEY`
    #[arg(long, value_name = "FILE")]
    key_file: Option<PathBuf>,
    /// Maximum number of concurrent clients
    #[arg(long, default_value_t = 32, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    max_clients: u16,
    #[command(flatten)]
    policy: PolicyArguments,
    /// File of the verifier [default: verifier.safetensors in the policy's folder, if it exists]
    #[arg(long, value_name = "FILE", help_heading = "Policy and verifier")]
    verifier: Option<PathBuf>,
    /// How the executed candidate is selected [default: verifier, or medoid without one]
    #[arg(long, value_parser = StrategyParser, help_heading = "Policy and verifier")]
    strategy: Option<Strategy>,
    /// Candidates per decision
    #[arg(long, default_value_t = 5, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=256), help_heading = "Policy and verifier")]
    candidates: u32,
    /// Sampling temperature
    #[arg(long, default_value_t = 1.0, value_name = "T", value_parser = temperature, help_heading = "Policy and verifier")]
    temperature: f32,
    /// Random seed, from which those of episodes are derived as in `rever evaluate`
    #[arg(long, default_value_t = 0, help_heading = "Policy and verifier")]
    seed: u64,
    /// Rotations in actions: a rotation vector, or roll, pitch and yaw
    #[arg(long, value_enum, default_value_t = RotationName::Vector, help_heading = "Wire")]
    rotation: RotationName,
    /// Gripper commands: +1 opens and -1 closes, -1 opens and +1 closes (LIBERO), or 1 opens and 0 closes
    #[arg(long, value_enum, default_value_t = GripperName::OpenPositive, help_heading = "Wire")]
    gripper: GripperName,
    /// Key of the camera in observations, such as `images/wrist` [default: the names that are common]
    #[arg(long, value_name = "KEY", help_heading = "Wire")]
    camera: Option<String>,
    /// Key of the robot's state in observations [default: the names that are common]
    #[arg(long, value_name = "KEY", help_heading = "Wire")]
    state: Option<String>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum RotationName {
    Vector,
    Euler,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum GripperName {
    OpenPositive,
    ClosePositive,
    OpenOne,
}

/// Serves until Ctrl-C or SIGTERM.
pub fn run(arguments: Arguments, host: &Host, output: Output) -> Result<()> {
    let key = arguments.key_file.as_deref().map(read_key).transpose()?;
    let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
    // Bound first: a port that is taken is an error before a policy of 15 GB is read.
    let listen = arguments.listen;
    let listener = runtime
        .block_on(TcpListener::bind(listen))
        .map_err(|error| WrongUsage(format!("--listen {listen}: cannot listen: {error}")))?;
    let address = listener.local_addr()?;
    if key.is_none() && !address.ip().is_loopback() {
        eprintln!(
            "warning: without --key-file, everybody who reaches {address} can use this policy"
        );
    }
    let loaded = arguments.policy.load(host)?;
    let verifier = loaded.verifier(arguments.verifier.clone())?;
    let setting = arguments.setting(verifier.is_some())?;
    loaded.policy.check(&setting).map_err(|error| WrongUsage(format!("{error:#}")))?;
    let (clients_max, candidates_max) =
        arguments.limits(loaded.network().map(|one| &**one), setting)?;
    let (seed, name) = (arguments.seed, loaded.name.clone());
    let form = ActionForm {
        rotation: match arguments.rotation {
            RotationName::Vector => Rotation::Vector,
            RotationName::Euler => Rotation::Euler,
        },
        gripper: match arguments.gripper {
            GripperName::OpenPositive => Gripper::OpenPositive,
            GripperName::ClosePositive => Gripper::ClosePositive,
            GripperName::OpenOne => Gripper::OpenOne,
        },
    };
    let options = AgentOptions {
        policy: loaded.policy,
        scorer: verifier.map(|verifier| verifier as Arc<dyn Scorer>),
        setting,
        candidates_max,
        seed,
        form,
        keys: ObservationKeys { camera: arguments.camera, state: arguments.state },
    };
    runtime.block_on(async {
        let agent =
            ServedAgent::start(options).map_err(|error| WrongUsage(format!("{error:#}")))?;
        let mut interrupts = signal(SignalKind::interrupt()).context("Ctrl-C")?;
        let mut terminations = signal(SignalKind::terminate()).context("SIGTERM")?;
        let (stopping, stopped) = watch::channel(false);
        tokio::spawn(async move {
            tokio::select! {
                _ = interrupts.recv() => {}
                _ = terminations.recv() => {}
            }
            stopping.send_replace(true);
        });
        if !output.is_quiet {
            eprintln!("{name}: {setting}, seed {seed}");
        }
        println!("ready ws://{address}");
        serve(listener, agent, ServerOptions { key, clients_max }, stopped).await
    })
}

impl Arguments {
    /// How many clients, and how many candidates each may ask for.
    fn limits(&self, policy: Option<&Vla>, setting: Setting) -> Result<(usize, u32)> {
        let (wanted, own) = (self.max_clients, setting.candidates);
        let most = own.max(CANDIDATES_MAX);
        let Some(policy) = policy else { return Ok((usize::from(wanted), most)) };
        let PolicyArguments { device, kv_cache, .. } = self.policy;
        let most = cache::candidates(policy, device, kv_cache, wanted, (own, most));
        let clients = cache::sessions(policy, device, kv_cache, wanted, most)?;
        Ok((usize::from(clients), most))
    }

    fn setting(&self, has_verifier: bool) -> Result<Setting> {
        let strategy = self.strategy.unwrap_or(match has_verifier {
            true => Strategy::Verifier,
            false => Strategy::Medoid,
        });
        if strategy.needs_verifier() && !has_verifier {
            return Err(WrongUsage(format!(
                "--strategy {strategy}: expected a verifier (--verifier FILE), got none"
            ))
            .into());
        }
        Ok(Setting::new(strategy, self.candidates, self.temperature))
    }
}

fn read_key(path: &Path) -> Result<ApiKey> {
    let key = policy_server::read_key(path).and_then(|key| ApiKey::new(&key));
    key.map_err(|error| WrongUsage(format!("--key-file {}: {error:#}", path.display())).into())
}
