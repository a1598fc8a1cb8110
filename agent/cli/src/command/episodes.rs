//! Running episodes: the arguments and the steps that `demo`, `evaluate` and `collect` share.

mod ready;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};
use clap::Args;
use decision::{Scorer, Setting, TaskId};
use evaluation::results::{Results, tasks_in_order};
use evaluation::suite::{Layouts, Suite};
use runtime::experiment::{Ending, Experiment, LoadScorer};
use runtime::rollout::RecordOptions;
use runtime::servers::{Deployment, Host, LocalSource, ServerSource, Simulator};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use store::labels::LabelStore;
use store::plan::{OfferedTask, SeedRange};
use store::run::{self, Run, RunRequest};
use tokio::runtime::Runtime;
use verifier::Verifier;
use vla::Vla;

use super::names::{self, FLEET_DEFAULT, endpoint, fleet};
use super::policy::PolicyArguments;
use super::{Output, WrongUsage, cache, selection};
use crate::{build_info, files};
use ready::Ready;

/// Default number of server processes on this machine.
const SERVERS_DEFAULT: u16 = 2;
/// Default number of concurrent episodes. Batches of this size amortize reading the weights from memory.
const SESSIONS_DEFAULT: u16 = 16;
/// The field of a run's header for options of the checkpoint.
pub const POLICY_OPTIONS: &str = "policy_options";
/// The field of a run's header for a policy server.
pub const POLICY_SERVER: &str = "policy_server";
/// The default label store.
const LABELS_DEFAULT: &str = "runs/labels.sqlite";

/// Which tasks to run, on which servers, and what to record.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Episodes")]
pub struct EpisodesArguments {
    /// Tasks, separated by commas: full names or words of them (`stack`), with `/VARIANT` for a variant; see
    /// `rever list tasks` [default: all tasks of the servers, in their default variant]
    #[arg(long, value_delimiter = ',', value_parser = task)]
    pub tasks: Vec<TaskId>,
    /// Random seed of initial layouts and samples
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    #[command(flatten)]
    pub policy: PolicyArguments,
    /// File of the verifier [default: verifier.safetensors in the policy's folder, if it exists]
    #[arg(long, value_name = "FILE", help_heading = "Policy and verifier")]
    pub verifier: Option<PathBuf>,
    /// Use the verifier that `rever train --name NAME` publishes; switch to its newest version between episodes
    #[arg(long, value_name = "NAME", value_parser = names::verifier, help_heading = "Policy and verifier")]
    pub follow_verifier: Option<String>,
    /// Server processes to start on this machine [default: 2]
    #[arg(long, conflicts_with = "connect", value_parser = clap::value_parser!(u16).range(1..=64), help_heading = "Servers")]
    pub servers: Option<u16>,
    /// Simulator of these servers
    #[arg(long, value_enum, default_value_t, conflicts_with = "connect", help_heading = "Servers")]
    pub simulator: Simulator,
    /// Use running servers: HOST:PORT of servers or of a zenoh router, separated by commas
    #[arg(long, value_name = "HOST:PORT", value_delimiter = ',', value_parser = endpoint, help_heading = "Servers")]
    pub connect: Vec<String>,
    /// Listen on HOST:PORT for peers, such as a trainer that publishes verifiers [default: a local socket]
    #[arg(long, value_name = "HOST:PORT", value_delimiter = ',', value_parser = endpoint, help_heading = "Servers")]
    pub listen: Vec<String>,
    /// Namespace: peers see each other only within the same fleet
    #[arg(long, default_value = FLEET_DEFAULT, value_parser = fleet, help_heading = "Servers")]
    pub fleet: String,
    /// Number of concurrent episodes
    #[arg(long, default_value_t = SESSIONS_DEFAULT, value_parser = clap::value_parser!(u16).range(1..=256), help_heading = "Servers")]
    pub sessions: u16,
    /// Python interpreter for the servers, which must have env-server's packages [default: an environment that rever sets up]
    #[arg(long, value_name = "FILE", help_heading = "Servers")]
    pub python: Option<PathBuf>,
    /// Folder of the run; rerun the same command to resume it [default: a folder under runs/]
    #[arg(long, value_name = "FOLDER", help_heading = "Files")]
    pub out: Option<PathBuf>,
    /// File of the label store
    #[arg(long, value_name = "FILE", default_value = LABELS_DEFAULT, help_heading = "Files")]
    pub labels: PathBuf,
    /// Record a video of every episode
    #[arg(long, help_heading = "Files")]
    pub video: bool,
    /// Record the hidden states of all candidates, not only of the executed one; always on in `collect --strategy sample`
    #[arg(long, help_heading = "Files")]
    pub all_hidden: bool,
}

/// What each command adds to the common arguments.
pub struct Request {
    /// Name of the command, for progress lines and default folders.
    pub title: &'static str,
    /// Episodes per task and setting.
    pub episodes: u32,
    /// Fixed or random initial layouts.
    pub layouts: Layouts,
    /// The range that seeds are drawn from.
    pub range: SeedRange,
    /// The settings that each episode is run with.
    pub settings: Vec<Setting>,
    /// Whether the settings are the command's defaults. Defaults that cannot be run are skipped.
    pub is_default: bool,
    /// How much to print.
    pub output: Output,
}

/// What a command gets when its episodes are done.
pub struct Outcome {
    /// The run's folder.
    pub folder: PathBuf,
    /// Rates and gains over all recorded episodes.
    pub results: Results,
    /// What determines the results: options, versions, build.
    pub provenance: Value,
    /// How the run ended: episodes that are missing or were given up.
    pub ending: Ending,
}

impl Default for EpisodesArguments {
    /// The defaults of the command line.
    fn default() -> Self {
        EpisodesArguments {
            tasks: Vec::new(),
            seed: 0,
            policy: PolicyArguments::default(),
            verifier: None,
            follow_verifier: None,
            servers: None,
            simulator: Simulator::default(),
            connect: Vec::new(),
            listen: Vec::new(),
            fleet: FLEET_DEFAULT.to_owned(),
            sessions: SESSIONS_DEFAULT,
            out: None,
            labels: PathBuf::from(LABELS_DEFAULT),
            video: false,
            all_hidden: false,
            python: None,
        }
    }
}

impl EpisodesArguments {
    /// Runs the episodes that are not recorded yet, then computes the results of all recorded ones.
    pub fn run(&self, host: &Host, request: Request) -> Result<Outcome> {
        let Ready { policy, network, settings, verifier, server, served } =
            self.ready(&request, host)?;
        let sessions = self.sessions_that_fit(network.as_deref(), &settings)?;
        let served = served.map(serde_json::to_value).transpose()?;
        let (digest, readings) = (policy.info().digest.clone(), server.is_some());
        // Opened now, so that a label store that cannot be used fails before any episode runs.
        LabelStore::open(&self.labels).map(drop)?;
        let runtime = Runtime::new().context("cannot start the async runtime")?;
        let versions = build_info::versions(&digest, verifier.as_deref().map(Verifier::digest));
        let names = |tasks: &[OfferedTask]| tasks.iter().map(|task| task.id.to_string()).collect();
        let (tasks, deployment) =
            match self.recorded_tasks(&request, &settings, &versions, server.as_ref()) {
                Some(tasks) => (tasks, None),
                None => {
                    let deployment = self.open_servers(&runtime, host, sessions)?;
                    (selection::offered(&self.tasks, &deployment, &runtime)?, Some(deployment))
                }
            };
        let options = self.options(names(&tasks), &request, &settings, server.as_ref());
        let suite = Suite {
            tasks,
            episodes: request.episodes,
            layouts: request.layouts,
            range: request.range,
            seed: self.seed,
        };
        let plans = suite.episodes().map_err(|error| WrongUsage(error.to_string()))?;
        let run_folder = self.run_folder(request.title, &options, &versions);
        let run = Run::open(&RunRequest {
            folder: run_folder.clone(),
            labels: Some(self.labels.clone()),
            options,
            versions,
            served,
            command: build_info::command_line(),
            build: build_info::build(),
        })?;
        let experiment = Experiment {
            title: request.title.to_owned(),
            plans,
            settings,
            policy,
            scorer: verifier.map(|verifier| verifier as Arc<dyn Scorer>),
            follow_verifier: self.follow_verifier.clone().map(|name| (name, load_scorer(digest))),
            sessions: usize::from(sessions),
            record: RecordOptions { all_hidden: self.all_hidden, video: self.video, readings },
            versions: build_info::record_versions(),
            is_quiet: request.output.is_quiet,
        };
        let ending = experiment.run(run, &runtime, || match deployment {
            Some(deployment) => Ok(deployment),
            None => self.open_servers(&runtime, host, sessions),
        })?;
        let (results, provenance) = results(&run_folder)?;
        Ok(Outcome { folder: run_folder, results, provenance, ending })
    }

    /// The full names of the tasks, if the run exists already. Servers are then started only if an episode is missing.
    fn recorded_tasks(
        &self,
        request: &Request,
        settings: &[Setting],
        versions: &Value,
        server: Option<&Value>,
    ) -> Option<Vec<OfferedTask>> {
        if self.tasks.is_empty() || request.layouts == Layouts::Grid {
            return None;
        }
        let typed = self.tasks.iter().map(TaskId::to_string).collect();
        let options = self.options(typed, request, settings, server);
        let folder = self.run_folder(request.title, &options, versions);
        let header = run::read_header(&folder).ok()?;
        let tasks = selection::matching(&self.tasks, &tasks_in_order(&header.options)).ok()?;
        let task = |id| OfferedTask { id, layouts: 0, steps_max: 0 };
        Some(tasks.into_iter().map(task).collect())
    }

    /// Everything that determines the results, by name. Servers and concurrency do not.
    fn options(
        &self,
        tasks: Vec<String>,
        request: &Request,
        settings: &[Setting],
        server: Option<&Value>,
    ) -> Value {
        let mut options = json!({
            "tasks": tasks,
            "episodes": request.episodes,
            "layouts": request.layouts,
            "seeds_from": request.range.first(),
            "seed": self.seed,
            "settings": settings.iter().map(Setting::to_string).collect::<Vec<_>>(),
            "follow_verifier": self.follow_verifier,
            // Devices add in a different order, which rarely changes which token is drawn.
            "device": self.policy.device.to_string(),
            "all_hidden": self.all_hidden,
            "video": self.video,
        });
        // The policy's digest covers them; a run without them has the header that it always had.
        if let Some(given) = self.policy.source.checkpoint.header() {
            options[POLICY_OPTIONS] = given;
        }
        if let Some(server) = server {
            options[POLICY_SERVER] = server.clone();
        }
        if let Some(weights) = self.policy.weights.header() {
            options["weights"] = weights;
        }
        options
    }

    /// The folder of `--out`, or one named after a digest of everything that determines the results.
    fn run_folder(&self, title: &str, options: &Value, versions: &Value) -> PathBuf {
        self.out.clone().unwrap_or_else(|| {
            let digest = Sha256::digest(format!("{options}{versions}"));
            let short: String = digest.iter().take(4).map(|byte| format!("{byte:02x}")).collect();
            Path::new("runs").join(format!("{title}-{short}"))
        })
    }

    /// The number of sessions whose keys and values fit into memory.
    fn sessions_that_fit(&self, policy: Option<&Vla>, settings: &[Setting]) -> Result<u16> {
        let candidates = settings.iter().map(|setting| setting.candidates).max().unwrap_or(1);
        let PolicyArguments { device, kv_cache, .. } = self.policy;
        match policy {
            Some(policy) => cache::sessions(policy, device, kv_cache, self.sessions, candidates),
            None => Ok(self.sessions),
        }
    }

    fn open_servers(&self, runtime: &Runtime, host: &Host, sessions: u16) -> Result<Deployment> {
        self.servers(host)?.open(runtime, usize::from(sessions))
    }

    /// The servers to start or to connect to.
    fn servers(&self, host: &Host) -> Result<ServerSource> {
        let start = || -> Result<LocalSource> {
            Ok(LocalSource {
                count: usize::from(self.servers.unwrap_or(SERVERS_DEFAULT)),
                simulator: self.simulator,
                python: self.python.clone(),
                installation: files::installation(host)?,
            })
        };
        Ok(ServerSource {
            local: self.connect.is_empty().then(start).transpose()?,
            connect: self.connect.clone(),
            listen: self.listen.clone(),
            fleet: self.fleet.clone(),
        })
    }
}

/// Number of episodes that a run's header asks for.
pub fn planned(header: &Value) -> u64 {
    let options = &header["options"];
    let settings = options["settings"].as_array().map_or(0, Vec::len) as u64;
    tasks_in_order(options).len() as u64 * settings * options["episodes"].as_u64().unwrap_or(0)
}

/// A loader of published verifiers for the policy with this digest.
fn load_scorer(policy: String) -> LoadScorer {
    Arc::new(move |update| {
        let verifier = Verifier::from_bytes(&update.weights, &policy)?;
        Ok(Arc::new(verifier) as Arc<dyn Scorer>)
    })
}

/// Parses the name of a task.
fn task(text: &str) -> Result<TaskId, String> {
    text.trim().parse()
}

/// The results of all recorded episodes of a run, and their provenance.
pub fn results(folder: &Path) -> Result<(Results, Value)> {
    let (header, summaries) = (run::read_header(folder)?, run::summaries(folder)?);
    let mut provenance = serde_json::to_value(&header)?;
    // This is the version of the header's format, not of the result file's.
    provenance.as_object_mut().map(|fields| fields.remove("version"));
    let simulator = summaries.first().map(|summary| summary.simulator.as_str());
    provenance["versions"]["simulator"] = json!(simulator);
    let tasks = tasks_in_order(&header.options);
    Ok((Results::new(&summaries, &run::faults(folder)?, &tasks)?, provenance))
}
