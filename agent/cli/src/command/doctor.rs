//! `rever doctor`: tries everything that a run needs, one thing after the other, and says what to do.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, ensure};
use clap::Args;
use protocol::{Open, PROTOCOL_VERSION, Reset};
use serde::Serialize;

use super::episodes::policy_folder;
use decision::{ActionSpace, Policy};
use decision::{Image, ProposalRequest};
use runtime::setup::{self, PythonEnvironment};
use runtime::simulator::{ServerProgram, Simulator};
use runtime::site::Site;
use runtime::wire::{Environment, Network, ServerDescription};
use store::plan::SeedRange;
use verifier::Verifier;
use vla::{DeviceName, Vla};

/// A server must be seen within this time of its start.
const SERVER_WAIT: Duration = Duration::from_secs(30);

/// Check everything that a run needs: Python, rendering, network, world, policy, verifier.
#[derive(Debug, Clone, Args)]
pub struct Arguments {
    /// The checkpoint's folder [default: the one that comes with rever]
    #[arg(long)]
    policy: Option<PathBuf>,
    /// The verifier's file [default: the one beside the policy's weights]
    #[arg(long)]
    verifier: Option<PathBuf>,
    /// Start a server of this simulator
    #[arg(long, value_enum, default_value_t)]
    simulator: Simulator,
    /// Check servers that run already instead of one started here
    #[arg(long, value_delimiter = ',')]
    connect: Vec<String>,
    /// Only servers of the same fleet are looked for
    #[arg(long, default_value = "local")]
    fleet: String,
    /// A Python that has the packages of env-server, instead of the one that rever sets up
    #[arg(long, value_name = "FILE")]
    python: Option<PathBuf>,
    /// Write the findings into this file, too
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// What one check found.
#[derive(Debug, Serialize)]
struct Finding {
    name: &'static str,
    is_ok: bool,
    /// What was found, or what is wrong and what to do.
    text: String,
}

/// Prints one line per check as it is done; an error when one fails.
pub fn run(arguments: Arguments) -> Result<()> {
    let mut findings = Vec::new();
    let site = Site {
        servers: usize::from(arguments.connect.is_empty()),
        simulator: arguments.simulator,
        connect: arguments.connect.clone(),
        fleet: arguments.fleet.clone(),
        python: arguments.python.clone(),
        ..Site::default()
    };
    let mut python = None;
    if site.servers > 0 {
        python = check(&mut findings, "python", || check_python(&site));
        if let Some(python) = &python {
            check(&mut findings, "rendering", || check_rendering(python));
        }
    }
    let folder = policy_folder(arguments.policy.as_ref())?;
    let policy = check(&mut findings, "policy", || check_policy(&folder));
    if let Some(policy) = &policy {
        let beside = folder.join("verifier.safetensors");
        let named = arguments.verifier.as_deref();
        if named.is_none() && !beside.is_file() {
            println!("none  verifier   `rever collect` and `rever train` make one");
        } else {
            let path = named.unwrap_or(&beside);
            check(&mut findings, "verifier", || check_verifier(path, policy));
        }
    }
    if python.is_some() || !arguments.connect.is_empty() {
        let size = policy.as_ref().map_or((128, 128), |policy| policy.info().image_size);
        let image = check(&mut findings, "world", || check_world(&site, python, size));
        if let (Some(policy), Some((image, instruction))) = (&policy, image) {
            check(&mut findings, "decision", || check_decision(policy, &image, &instruction));
        }
    }
    if let Some(path) = &arguments.json {
        let text = serde_json::to_string_pretty(&findings)?;
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
    }
    let failed: Vec<&str> =
        findings.iter().filter(|finding| !finding.is_ok).map(|finding| finding.name).collect();
    ensure!(failed.is_empty(), "not ready: {}", failed.join(", "));
    println!("ready: try `rever demo`");
    Ok(())
}

/// Does one check and prints what came of it.
fn check<T>(
    findings: &mut Vec<Finding>,
    name: &'static str,
    examine: impl FnOnce() -> Result<(T, String)>,
) -> Option<T> {
    let (found, finding) = match examine() {
        Ok((found, text)) => (Some(found), Finding { name, is_ok: true, text }),
        Err(error) => (None, Finding { name, is_ok: false, text: format!("{error:#}") }),
    };
    println!("{} {name:<10} {}", if finding.is_ok { "ok   " } else { "FAULT" }, finding.text);
    findings.push(finding);
    found
}

fn check_python(site: &Site) -> Result<(PythonEnvironment, String)> {
    let python = site.python_environment()?;
    let versions = "import sys, mujoco, numpy, zenoh; print('python', sys.version.split()[0], \
                    'mujoco', mujoco.__version__, 'numpy', numpy.__version__)";
    let output = python.command().args(["-c", versions]).output().context("cannot start python")?;
    ensure!(
        output.status.success(),
        "{} lacks a package: {}",
        python.python.display(),
        String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or_default()
    );
    let text = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    let place = python.python.display().to_string();
    Ok((python, format!("{text} ({place})")))
}

fn check_rendering(python: &PythonEnvironment) -> Result<((), String)> {
    setup::software_gl(python)?;
    Ok(((), "one frame rendered with software OpenGL (EGL)".to_owned()))
}

fn check_policy(folder: &Path) -> Result<(Vla, String)> {
    let begun = Instant::now();
    let policy = Vla::load(folder, DeviceName::Cpu)?;
    let (height, width) = policy.info().image_size;
    let text = format!(
        "{} loaded in {} ms: digest {}, images {height} x {width}, hidden state {}",
        folder.display(),
        begun.elapsed().as_millis(),
        short(policy.parser().digest()),
        policy.parser().hidden_size()
    );
    Ok((policy, text))
}

fn check_verifier(path: &Path, policy: &Vla) -> Result<((), String)> {
    let verifier = Verifier::load(path, policy.parser().digest())?;
    Ok(((), format!("{}: digest {}, fits the policy", path.display(), short(verifier.digest()))))
}

/// Opens the network on this machine, finds a server, resets a world and steps it once.
fn check_world(
    site: &Site,
    python: Option<PythonEnvironment>,
    image_size: (usize, usize),
) -> Result<((Image, String), String)> {
    let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
    let network = runtime.block_on(Network::open(site.network_options()))?;
    let start = |python| -> Result<_> {
        site.start(ServerProgram::prepare(site.simulator, python)?, &network, 1)
    };
    let local = python.map(start).transpose()?;
    let result = runtime.block_on(try_world(&network, image_size));
    drop(local);
    runtime.block_on(network.close())?;
    result
}

async fn try_world(
    network: &Network,
    image_size: (usize, usize),
) -> Result<((Image, String), String)> {
    let servers = network.servers(1, SERVER_WAIT).await.servers;
    let server = servers.values().next().context(
        "no environment server found: start one with `python -m rever_env serve`, or check --connect and --fleet",
    )?;
    let task = server.tasks.first().context("the server offers no task")?;
    let open = Open {
        protocol: PROTOCOL_VERSION,
        task: task.task.clone(),
        variant: task.variant.clone(),
        image_height: image_size.0 as u32,
        image_width: image_size.1 as u32,
        expert: false,
        holder: "doctor".to_owned(),
    };
    let environment = Environment::open(network, &server.server, open).await?;
    let reset = Reset {
        task: task.task.clone(),
        variant: task.variant.clone(),
        layout: None,
        seed: SeedRange::Tuning.first(),
    };
    let mut episode = environment.reset(reset).await?;
    let begun = Instant::now();
    episode.step(&ActionSpace::hold_still(&task.action)).await?;
    let step_ms = begun.elapsed().as_secs_f64() * 1000.0;
    let observation = episode.observation().clone();
    let environment = episode.finish();
    environment.close().await?;
    let text = format!("{}; one step took {step_ms:.1} ms", described(server, servers.len()));
    Ok(((observation.image, observation.instruction), text))
}

fn described(server: &ServerDescription, servers: usize) -> String {
    format!(
        "{servers} server(s), protocol {} here and {} there, {} {}, {} tasks",
        PROTOCOL_VERSION,
        server.protocol,
        server.simulator,
        server.simulator_version,
        server.tasks.len()
    )
}

fn check_decision(policy: &Vla, image: &Image, instruction: &str) -> Result<((), String)> {
    let request = ProposalRequest {
        image,
        state: &[],
        instruction,
        candidates: 5,
        temperature: 1.0,
        seed: 0,
    };
    let begun = Instant::now();
    let proposals = policy.propose_now(&[request])?;
    let milliseconds = begun.elapsed().as_millis();
    let candidates =
        &proposals.first().ok_or_else(|| anyhow!("the policy answered nothing"))?.candidates;
    let well_formed = candidates.iter().filter(|candidate| candidate.parsed.is_ok()).count();
    let count = candidates.len();
    ensure!(well_formed > 0, "none of {count} candidates was well formed: is this policy trained?");
    Ok(((), format!("{well_formed} of {count} candidates well formed, in {milliseconds} ms")))
}

fn short(digest: &str) -> &str {
    digest.get(..12).unwrap_or(digest)
}
