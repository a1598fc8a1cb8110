//! `rever doctor`: checks everything that a run needs and reports what is missing.
//!
//! It changes nothing on the machine. For a missing part it prints the command that installs it.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, anyhow, ensure};
use clap::Args;
use decision::{ActionSpace, Observation, Policy, PolicyInfo, ProposalRequest};
use protocol::{Open, PROTOCOL_VERSION, Reset};
use runtime::rollout::first_malformed;
use runtime::servers::{
    Deployment, Host, Installation, LocalSource, Missing, PythonEnvironment, ServerProgram,
    ServerSource, Simulator,
};
use runtime::wire::{Environment, ServerDescription};
use serde::Serialize;
use store::plan::SeedRange;
use tokio::runtime::Runtime;
use verifier::Verifier;

use super::names::{FLEET_DEFAULT, endpoint, fleet, short};
use super::policy::{LoadedPolicy, PolicyArguments, verifier_beside};
use crate::files;

/// The image size if no policy could be loaded.
const IMAGE_SIZE_DEFAULT: (usize, usize) = (128, 128);

/// Check what a run needs and change nothing: Python, rendering, policy, verifier, servers
#[derive(Debug, Clone, Args)]
pub struct Arguments {
    /// File of the verifier [default: verifier.safetensors in the policy's folder]
    #[arg(long, value_name = "FILE", help_heading = "Policy and verifier")]
    verifier: Option<PathBuf>,
    /// Start a server of this simulator
    #[arg(long, value_enum, default_value_t, conflicts_with = "connect")]
    simulator: Simulator,
    /// Check running servers instead of one started here: HOST:PORT, separated by commas
    #[arg(long, value_name = "HOST:PORT", value_delimiter = ',', value_parser = endpoint)]
    connect: Vec<String>,
    /// Namespace: peers see each other only within the same fleet
    #[arg(long, default_value = FLEET_DEFAULT, value_parser = fleet)]
    fleet: String,
    /// Python interpreter for the server, which must have env-server's packages [default: an environment that rever sets up]
    #[arg(long, value_name = "FILE")]
    python: Option<PathBuf>,
    /// Also write the findings to this file
    #[arg(long, value_name = "FILE", value_parser = super::output_file)]
    json: Option<PathBuf>,
    #[command(flatten)]
    policy: PolicyArguments,
}

/// What one check found.
#[derive(Debug, Serialize)]
struct Finding {
    name: &'static str,
    is_ok: bool,
    /// What was found, or what is wrong and how to fix it.
    text: String,
}

/// Prints one line per check as soon as it is done. Returns an error if a check fails.
pub fn run(arguments: Arguments, host: &Host) -> Result<()> {
    let mut findings = Vec::new();
    let installation = files::installation_unchanged(host)?;
    let named = arguments.policy.source.policy.clone();
    let folder = match arguments.policy.source.address() {
        Some(_) => None,
        None => Some(named.unwrap_or_else(|| installation.policy_folder())),
    };
    let source = ServerSource {
        local: arguments.connect.is_empty().then_some(LocalSource {
            count: 1,
            simulator: arguments.simulator,
            python: arguments.python,
            installation: installation.clone(),
        }),
        connect: arguments.connect,
        listen: Vec::new(),
        fleet: arguments.fleet,
    };
    let mut program = None;
    if let Some(local) = &source.local {
        let python = check(&mut findings, "python", || check_python(local));
        if let Some(python) = python {
            check(&mut findings, "rendering", || check_rendering(&python, local));
            program = check(&mut findings, "simulator", || check_simulator(local));
        }
    }
    let policy = check(&mut findings, "policy", || {
        check_policy(&arguments.policy, folder.as_deref(), &installation, host)
    });
    if let Some(policy) = &policy {
        let beside = folder.as_deref().and_then(verifier_beside);
        match arguments.verifier.as_ref().or(beside.as_ref()) {
            Some(path) => drop(check(&mut findings, "verifier", || {
                check_verifier(path, &installation, policy.as_ref())
            })),
            None if folder.is_none() => println!("none  verifier    a policy server has none"),
            None => println!("none  verifier    train one with `rever collect` and `rever train`"),
        }
    }
    if program.is_some() || source.local.is_none() {
        let size = policy.as_ref().map_or(IMAGE_SIZE_DEFAULT, |policy| policy.info().image_size);
        let runtime = Runtime::new().context("cannot start the async runtime")?;
        let check_environment = || check_environment(&runtime, &source, program, size);
        let observation = check(&mut findings, "environment", check_environment);
        if let (Some(policy), Some(observation)) = (&policy, observation) {
            let decide = || check_decision(&runtime, policy.as_ref(), &observation);
            check(&mut findings, "decision", decide);
        }
    }
    if let Some(path) = &arguments.json {
        let text = serde_json::to_string_pretty(&findings)?;
        std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))?;
    }
    let failed: Vec<&str> =
        findings.iter().filter(|finding| !finding.is_ok).map(|finding| finding.name).collect();
    ensure!(failed.is_empty(), "not ready: {}", failed.join(", "));
    println!("ready: try `rever demo{}`", arguments.policy.words());
    Ok(())
}

/// Runs one check and prints its finding.
fn check<T>(
    findings: &mut Vec<Finding>,
    name: &'static str,
    examine: impl FnOnce() -> Result<(T, String)>,
) -> Option<T> {
    let (found, finding) = match examine() {
        Ok((found, text)) => (Some(found), Finding { name, is_ok: true, text }),
        Err(error) => (None, Finding { name, is_ok: false, text: format!("{error:#}") }),
    };
    println!("{} {name:<11} {}", if finding.is_ok { "ok   " } else { "FAULT" }, finding.text);
    findings.push(finding);
    found
}

fn check_python(local: &LocalSource) -> Result<(PythonEnvironment, String)> {
    let python = local.python_environment(Missing::Report)?;
    let versions = "import sys, mujoco, numpy, zenoh; print('python', sys.version.split()[0], \
                    'mujoco', mujoco.__version__, 'numpy', numpy.__version__)";
    let output = python.command().args(["-c", versions]).output();
    let output = output.with_context(|| format!("cannot start {}", python.python.display()))?;
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

fn check_rendering(python: &PythonEnvironment, local: &LocalSource) -> Result<((), String)> {
    python.ensure_rendering(&local.installation, Missing::Report)?;
    Ok(((), "one image rendered with software OpenGL (EGL)".to_owned()))
}

fn check_simulator(local: &LocalSource) -> Result<(ServerProgram, String)> {
    let program = local.program(Missing::Report)?;
    let text = format!("{}: {}", local.simulator, program.command().get_program().display());
    Ok((program, text))
}

fn check_policy(
    arguments: &PolicyArguments,
    folder: Option<&Path>,
    installation: &Installation,
    host: &Host,
) -> Result<(Arc<dyn Policy>, String)> {
    let begun = Instant::now();
    let loaded = match folder {
        Some(folder) => arguments.load_folder(folder.to_owned(), host)?,
        None => arguments.load(host)?,
    };
    let LoadedPolicy { policy, checkpoint, server, name, .. } = loaded;
    let PolicyInfo { digest, image_size: (height, width), hidden_size, .. } = policy.info();
    let hidden = hidden_size.map_or("none".to_owned(), |size| size.to_string());
    let mut description = checkpoint.iter().flat_map(|one| one.parser().description());
    let thought = description.find(|(name, _)| *name == "chain of thought");
    let thought = thought.map_or_else(|| "unknown".to_owned(), |(_, value)| value);
    let last = match server {
        Some(server) => format!("profile {}", server.profile_name()),
        None => format!("chain of thought: {thought}"),
    };
    let text = format!(
        "{}: loaded in {} ms, digest {}, images {height} x {width}, hidden size {hidden}, {last}",
        folder.map_or(name, |folder| place(folder, installation)),
        begun.elapsed().as_millis(),
        short(digest),
    );
    Ok((policy, text))
}

fn check_verifier(
    path: &Path,
    installation: &Installation,
    policy: &dyn Policy,
) -> Result<((), String)> {
    let verifier = Verifier::load(path, &policy.info().digest)?;
    let place = place(path, installation);
    Ok(((), format!("{place}: digest {}, matches the policy", short(verifier.digest()))))
}

/// The path to print. A temporary installation is deleted when the command ends, so its paths are not printed.
fn place(path: &Path, installation: &Installation) -> String {
    match path.strip_prefix(&installation.root) {
        Ok(name) if installation.is_temporary() => format!("embedded {}", name.display()),
        _ => path.display().to_string(),
    }
}

/// Opens the network, finds a server, resets an environment and steps it once.
fn check_environment(
    runtime: &Runtime,
    source: &ServerSource,
    program: Option<ServerProgram>,
    image_size: (usize, usize),
) -> Result<(Observation, String)> {
    let deployment = source.open_with(program, runtime, 1)?;
    let result = runtime.block_on(try_environment(&deployment, image_size));
    deployment.close(runtime)?;
    result
}

async fn try_environment(
    deployment: &Deployment,
    image_size: (usize, usize),
) -> Result<(Observation, String)> {
    let network = &deployment.network;
    let servers = deployment.first_servers().await?.servers;
    let server = servers.values().next().context("no environment server found")?;
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
    Ok((observation, text))
}

fn described(server: &ServerDescription, servers: usize) -> String {
    format!(
        "{servers} server(s), protocol {} (server: {}), {} {}, {} tasks",
        PROTOCOL_VERSION,
        server.protocol,
        server.simulator,
        server.simulator_version,
        server.tasks.len()
    )
}

fn check_decision(
    runtime: &Runtime,
    policy: &dyn Policy,
    observation: &Observation,
) -> Result<((), String)> {
    let request = ProposalRequest {
        image: &observation.image,
        state: &observation.state,
        instruction: &observation.instruction,
        candidates: 5,
        temperature: 1.0,
        seed: 0,
        episode: None,
    };
    let begun = Instant::now();
    let proposals = runtime.block_on(policy.propose(&[request]))?;
    let milliseconds = begun.elapsed().as_millis();
    let candidates =
        &proposals.first().ok_or_else(|| anyhow!("the policy returned no proposal"))?.candidates;
    let well_formed = candidates.iter().filter(|candidate| candidate.parsed.is_ok()).count();
    let count = candidates.len();
    let read =
        "is the checkpoint read as it was trained (--reasoning, --prompt, --max-new-tokens)?";
    ensure!(
        well_formed > 0,
        "none of {count} candidates is well formed; {}; {read}",
        candidates.first().map_or_else(String::new, |first| first_malformed(first, policy))
    );
    let parsed = candidates.iter().filter_map(|candidate| candidate.parsed.as_ref().ok());
    let partly = parsed.filter(|parsed| !parsed.reasoning.unread.is_empty()).count();
    let partly = if partly > 0 { format!(", {partly} partly read") } else { String::new() };
    Ok((
        (),
        format!("{well_formed} of {count} candidates well formed{partly}, in {milliseconds} ms"),
    ))
}
