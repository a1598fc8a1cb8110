//! The arguments that every command which runs episodes takes.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use clap::Args;
use decision::{Scorer, Setting, TaskId};
use evaluation::results::{Results, tasks_in_order};
use evaluation::suite::{Layouts, Suite};
use runtime::experiment::{self, Ending, Experiment, LoadScorer};
use runtime::rollout::RecordOptions;
use runtime::servers::{Deployment, Host, LocalSource, ServerSource, Simulator};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use store::labels::LabelStore;
use store::plan::{OfferedTask, SeedRange};
use store::run::{self, Run, RunRequest};
use tokio::runtime::Runtime;
use verifier::Verifier;
use vla::{DeviceName, Vla};

use super::WrongUsage;
use super::names::{self, FLEET_DEFAULT, endpoint, fleet};
use crate::{build_info, files};

/// Processes on this machine unless others are named.
const SERVERS_DEFAULT: u16 = 2;
/// Episodes at once: enough that a matrix product is worth reading its weights.
const SESSIONS_DEFAULT: u16 = 16;
/// The label store of those that name none.
const LABELS_DEFAULT: &str = "runs/labels.sqlite";

/// Which tasks, where, and what is kept of them.
#[derive(Debug, Clone, Args)]
pub struct EpisodesArguments {
    /// Tasks, separated by commas, each as TASK or TASK/VARIANT [default: all that the servers offer in their default variant].
    #[arg(long, value_delimiter = ',')]
    pub tasks: Vec<TaskId>,
    /// Seed of the suite: another number gives other layouts and other samples.
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// The checkpoint's folder [default: the one that comes with rever].
    #[arg(long)]
    pub policy: Option<PathBuf>,
    /// Where the policy computes: cpu, cuda or cuda:N.
    #[arg(long, default_value_t)]
    pub device: DeviceName,
    /// The verifier's file [default: the one beside the policy's weights, if there is one].
    #[arg(long)]
    pub verifier: Option<PathBuf>,
    /// Follow a published verifier: take up its newest version between episodes.
    #[arg(long, value_name = "NAME", value_parser = names::verifier)]
    pub follow_verifier: Option<String>,
    /// Server processes to start on this machine [default: 2].
    #[arg(long, conflicts_with = "connect", value_parser = clap::value_parser!(u16).range(1..=64))]
    pub servers: Option<u16>,
    /// The simulator of these servers.
    #[arg(long, value_enum, default_value_t, conflicts_with = "connect")]
    pub simulator: Simulator,
    /// Use servers that are running: endpoints of them or of a router, as tcp/HOST:PORT.
    #[arg(long, value_delimiter = ',', value_parser = endpoint)]
    pub connect: Vec<String>,
    /// Listen here for others, such as a trainer that publishes verifiers [default: a socket of this machine, printed at the start].
    #[arg(long, value_name = "ENDPOINT", value_delimiter = ',', value_parser = endpoint)]
    pub listen: Vec<String>,
    /// Namespace: peers see each other only within the same fleet.
    #[arg(long, default_value = FLEET_DEFAULT, value_parser = fleet)]
    pub fleet: String,
    /// Episodes at once.
    #[arg(long, default_value_t = SESSIONS_DEFAULT, value_parser = clap::value_parser!(u16).range(1..=256))]
    pub sessions: u16,
    /// The run's folder; the same command resumes it [default: under runs/].
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// The label store.
    #[arg(long, default_value = LABELS_DEFAULT)]
    pub labels: PathBuf,
    /// Keep a video of every episode.
    #[arg(long)]
    pub video: bool,
    /// Keep the hidden states of all candidates, not only of the executed ones.
    #[arg(long)]
    pub all_hidden: bool,
    /// A Python that has the packages of env-server, instead of the one that rever sets up.
    #[arg(long, value_name = "FILE")]
    pub python: Option<PathBuf>,
}

/// What a command asks for beside the common arguments.
pub struct Request {
    /// The command's name, in progress lines and default folders.
    pub title: &'static str,
    /// Episodes of each task.
    pub episodes: u32,
    /// Where objects start.
    pub layouts: Layouts,
    /// What the seeds may be used for.
    pub range: SeedRange,
    /// How each episode is run.
    pub settings: Vec<Setting>,
}

/// What a command has when its episodes are done.
pub struct Outcome {
    /// The run's folder.
    pub folder: PathBuf,
    /// The checkpoint's folder.
    pub policy: PathBuf,
    /// Rates and gains of all that is recorded.
    pub results: Results,
    /// What decides the results: options, versions, build.
    pub provenance: Value,
    /// What became of the episodes.
    pub ending: Ending,
}

impl Default for EpisodesArguments {
    /// As the command line has it.
    fn default() -> Self {
        EpisodesArguments {
            tasks: Vec::new(),
            seed: 0,
            policy: None,
            device: DeviceName::Cpu,
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
    /// Runs what is not recorded yet, and computes the results of all that is.
    pub fn run(&self, host: &Host, request: Request) -> Result<Outcome> {
        let folder = files::policy_folder(self.policy.as_ref(), host)?;
        let policy = Vla::load(&folder, self.device)?;
        let digest = policy.parser().digest().to_owned();
        let verifier = self.verifier(&folder, &digest)?;
        self.check(&request, verifier.as_deref())?;
        let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
        let (tasks, mut deployment) = self.tasks(request.layouts, &runtime, host)?;
        let suite = Suite {
            tasks,
            episodes: request.episodes,
            layouts: request.layouts,
            range: request.range,
            seed: self.seed,
        };
        let plans = suite.episodes().map_err(|error| WrongUsage(error.to_string()))?;
        let options = self.options(&suite, &request.settings);
        let versions = build_info::versions(&digest, verifier.as_deref().map(Verifier::digest));
        let run_folder = self.run_folder(request.title, &options, &versions);
        if deployment.is_none() && !run_folder.exists() {
            // Refused here, a task that nobody offers leaves no run behind.
            let servers = self.open_servers(&runtime, host)?;
            runtime.block_on(experiment::offered_tasks(&servers, &self.tasks))?;
            deployment = Some(servers);
        }
        let run = Run::open(&RunRequest {
            folder: run_folder.clone(),
            labels: Some(self.labels.clone()),
            options,
            versions,
            command: build_info::command_line(),
            build: build_info::build(),
        })?;
        let experiment = Experiment {
            title: request.title.to_owned(),
            plans,
            settings: request.settings,
            policy: Arc::new(policy),
            scorer: verifier.map(|verifier| verifier as Arc<dyn Scorer>),
            follow_verifier: self.follow_verifier.clone().map(|name| (name, load_scorer(digest))),
            sessions: usize::from(self.sessions),
            record: RecordOptions { all_hidden: self.all_hidden, video: self.video },
            versions: build_info::record_versions(),
        };
        let ending = experiment.run(run, &runtime, || match deployment {
            Some(deployment) => Ok(deployment),
            None => self.open_servers(&runtime, host),
        })?;
        let (results, provenance) = results(&run_folder)?;
        Ok(Outcome { folder: run_folder, policy: folder, results, provenance, ending })
    }

    /// The named verifier, or the one beside the policy's weights; none where one is followed and none is named.
    fn verifier(&self, policy: &Path, digest: &str) -> Result<Option<Arc<Verifier>>> {
        let beside = policy.join("verifier.safetensors");
        let is_beside = self.follow_verifier.is_none() && beside.is_file();
        let path = self.verifier.clone().or_else(|| is_beside.then_some(beside));
        path.map(|path| Ok(Arc::new(Verifier::load(&path, digest)?))).transpose()
    }

    /// Wrong usage that can be told before anything is started.
    fn check(&self, request: &Request, verifier: Option<&Verifier>) -> Result<()> {
        let needing = request.settings.iter().find(|setting| setting.strategy.needs_verifier());
        if let (Some(setting), None, None) = (needing, verifier, &self.follow_verifier) {
            let strategy = setting.strategy;
            bail!(WrongUsage(format!(
                "strategy {strategy}: expected a verifier (--verifier FILE), got none"
            )));
        }
        // Made, if there is none, before anything is run for it.
        LabelStore::open(&self.labels).map(drop)
    }

    /// The tasks that were asked for, or all that servers offer. Servers are started here only where their descriptions are
    /// needed: for the list of tasks, or for the number of fixed layouts.
    fn tasks(
        &self,
        layouts: Layouts,
        runtime: &Runtime,
        host: &Host,
    ) -> Result<(Vec<OfferedTask>, Option<Deployment>)> {
        if !self.tasks.is_empty() && layouts == Layouts::Random {
            let unasked = |id: &TaskId| OfferedTask { id: id.clone(), layouts: 0 };
            return Ok((self.tasks.iter().map(unasked).collect(), None));
        }
        let deployment = self.open_servers(runtime, host)?;
        let tasks = match &self.tasks[..] {
            [] => runtime.block_on(experiment::default_tasks(&deployment))?,
            wanted => runtime.block_on(experiment::offered_tasks(&deployment, wanted))?,
        };
        Ok((tasks, Some(deployment)))
    }

    /// Everything that decides the results, by name. Where it runs and how many episodes at once does not.
    fn options(&self, suite: &Suite, settings: &[Setting]) -> Value {
        let Suite { tasks, episodes, layouts, range, seed } = suite;
        json!({
            "tasks": tasks.iter().map(|task| task.id.to_string()).collect::<Vec<_>>(),
            "episodes": episodes,
            "layouts": layouts,
            "seeds_from": range.first(),
            "seed": seed,
            "settings": settings.iter().map(Setting::to_string).collect::<Vec<_>>(),
            "follow_verifier": self.follow_verifier,
            // Sums in another order: the same draws, but for the rare one between two tokens.
            "device": self.device.to_string(),
            "all_hidden": self.all_hidden,
            "video": self.video,
        })
    }

    /// The named run's folder, or one that is named after what decides its results.
    fn run_folder(&self, title: &str, options: &Value, versions: &Value) -> PathBuf {
        self.out.clone().unwrap_or_else(|| {
            let digest = Sha256::digest(format!("{options}{versions}"));
            let short: String = digest.iter().take(4).map(|byte| format!("{byte:02x}")).collect();
            Path::new("runs").join(format!("{title}-{short}"))
        })
    }

    fn open_servers(&self, runtime: &Runtime, host: &Host) -> Result<Deployment> {
        self.servers(host)?.open(runtime, usize::from(self.sessions))
    }

    /// Where the servers come from.
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

/// Reads published verifiers for the policy with this digest.
fn load_scorer(policy: String) -> LoadScorer {
    Arc::new(move |update| {
        let verifier = Verifier::from_bytes(&update.weights, &policy)?;
        Ok(Arc::new(verifier) as Arc<dyn Scorer>)
    })
}

/// Results of all that is recorded in a run, and what they were made with.
fn results(folder: &Path) -> Result<(Results, Value)> {
    let (header, summaries) = (run::read_header(folder)?, run::summaries(folder)?);
    let mut provenance = serde_json::to_value(&header)?;
    // Of the header's form, not of the result file's.
    provenance.as_object_mut().map(|fields| fields.remove("version"));
    let simulator = summaries.first().map(|summary| summary.simulator.as_str());
    provenance["versions"]["simulator"] = json!(simulator);
    let tasks = tasks_in_order(&header.options);
    Ok((Results::new(&summaries, &run::faults(folder)?, &tasks)?, provenance))
}
