//! One run from beginning to end: policy, verifier, servers, rollouts, records, labels, results.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::collector::{Collector, catch_up};
use store::labels::LabelStore;
use vla::{DeviceName, Vla};
use crate::progress::Progress;
use evaluation::results::Results;
use crate::rollout::{Crew, Journal, Keep, Rollout};
use store::queue::Queue;
use store::run::{self, EpisodeSummary, Run};
use crate::servers::LocalServers;
use crate::site::Site;
use crate::stop::{self, Stop};
use decision::{Setting, VARIANT_DEFAULT};
use store::plan::EpisodePlan;
use evaluation::suite::Suite;
use verifier::Verifier;
use crate::wire::{Network, OutcomePublisher, ServerDescription, VerifierSubscriber};

/// Servers run already; this is for the way to them.
const SERVERS_WAIT: Duration = Duration::from_secs(30);
/// After some of them have.
const OTHERS_WAIT: Duration = Duration::from_secs(2);
/// A run that needs a verifier and follows one waits this long for the first.
const VERIFIER_WAIT: Duration = Duration::from_secs(60);

/// What to run, where, and what to keep.
#[derive(Debug, Clone)]
pub struct Campaign {
    /// The command's name: in progress lines and in the default folder.
    pub title: String,
    /// Which episodes.
    pub suite: Suite,
    /// How each of them is run.
    pub settings: Vec<Setting>,
    /// The checkpoint's folder.
    pub policy: PathBuf,
    /// Where the policy computes.
    pub device: DeviceName,
    /// The verifier's file, if there is one to score with.
    pub verifier: Option<PathBuf>,
    /// The name of a published verifier whose newest version is taken up between episodes.
    pub follow_verifier: Option<String>,
    /// Where the world is.
    pub site: Site,
    /// Episodes at once.
    pub sessions: usize,
    /// The run's folder; by default one that is named after the options, so that the same command goes on.
    pub out: Option<PathBuf>,
    /// The label store.
    pub labels: PathBuf,
    /// What records hold beside the necessary.
    pub keep: Keep,
}

/// What a campaign came to, so far.
#[derive(Debug)]
pub struct Report {
    /// The run's folder.
    pub folder: PathBuf,
    /// Rates and gains of all that is recorded.
    pub results: Results,
    /// Of everything that the results depend on.
    pub versions: Value,
    /// Episodes without a record.
    pub missing: usize,
    /// Episodes altogether.
    pub planned: usize,
    /// Whether somebody stopped it.
    pub was_stopped: bool,
}

impl Report {
    /// An error when some episode has no outcome, for a partial result must not pass for a whole one.
    pub fn ensure_complete(&self) -> Result<()> {
        if self.missing == 0 {
            return Ok(());
        }
        let why = if self.was_stopped { "stopped" } else { "faults" };
        bail!(
            "{why}: {} of {} episodes have no outcome; the same command goes on with {}",
            self.missing,
            self.planned,
            self.folder.display()
        )
    }
}

impl Campaign {
    /// Runs what is not recorded yet.
    pub fn run(&self) -> Result<Report> {
        let policy = Policy::load(&self.policy, self.device)?;
        let verifier = match &self.verifier {
            Some(path) => Some(Arc::new(Verifier::load(path, policy.digest())?)),
            None => None,
        };
        self.check(verifier.is_some())?;
        let (options, versions) = (self.options(), self.versions(&policy, verifier.as_deref()));
        let folder = self.out.clone().unwrap_or_else(|| self.default_folder(&options, &versions));
        let run = Run::open(&folder, options, versions)?;
        let labels = LabelStore::open(&self.labels)?;
        catch_up(&labels, &run)?;

        let plans = self.suite.episodes();
        let recorded = run::recorded(&folder)?;
        let queue = Queue::new(&run.header.run, &plans, &self.settings, &recorded);
        let mut was_stopped = false;
        if !queue.is_empty() {
            let runtime =
                tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
            let stage = Stage { policy: &policy, verifier, run, queue, labels };
            was_stopped = self.roll_out(&runtime, stage)?;
        }
        self.report(&folder, &plans, was_stopped)
    }

    fn check(&self, has_verifier: bool) -> Result<()> {
        ensure!(!self.settings.is_empty(), "strategies: expected at least one, got none");
        ensure!(self.sessions > 0, "sessions: expected at least 1, got 0");
        let needing = self.settings.iter().find(|setting| setting.strategy.needs_verifier());
        if let (Some(setting), false, None) = (needing, has_verifier, &self.follow_verifier) {
            bail!("strategy {}: expected a verifier (--verifier FILE), got none", setting.strategy);
        }
        Ok(())
    }

    /// Everything that decides the results, by name. Where it runs and how many episodes at once does not.
    fn options(&self) -> Value {
        let Suite { tasks, episodes, layouts, range, seed } = &self.suite;
        json!({
            "tasks": tasks,
            "episodes": episodes,
            "layouts": layouts,
            "seeds_from": range.first(),
            "seed": seed,
            "settings": self.settings.iter().map(Setting::to_string).collect::<Vec<_>>(),
            "follow_verifier": self.follow_verifier,
            // Sums in another order: the same draws, but for the rare one between two tokens. Left out on the processor,
            // where runs from before there was a choice go on.
            "device": (self.device != DeviceName::Cpu).then(|| self.device.to_string()),
            "all_hidden": self.keep.all_hidden,
            "video": self.keep.video,
        })
    }

    fn versions(&self, policy: &Policy, verifier: Option<&Verifier>) -> Value {
        json!({
            "rever": env!("CARGO_PKG_VERSION"),
            "protocol": protocol::PROTOCOL_VERSION,
            "policy": policy.digest(),
            "verifier": verifier.map(Verifier::digest),
        })
    }

    fn default_folder(&self, options: &Value, versions: &Value) -> PathBuf {
        let digest = Sha256::digest(format!("{options}{versions}"));
        let short: String = digest.iter().take(4).map(|byte| format!("{byte:02x}")).collect();
        Path::new("runs").join(format!("{}-{short}", self.title))
    }

    /// Starts everything, rolls out, ends everything. True when somebody stopped it.
    fn roll_out(&self, runtime: &tokio::runtime::Runtime, stage: Stage<'_>) -> Result<bool> {
        self.site.run(runtime, self.sessions, async |network, local| {
            self.roll_out_on(network, local, stage).await
        })
    }

    async fn roll_out_on(
        &self,
        network: &Network,
        local: Option<&LocalServers>,
        stage: Stage<'_>,
    ) -> Result<bool> {
        let Stage { policy, verifier, run, queue, labels } = stage;
        let servers = self.check_tasks(network).await?;
        let name = run.header.run.clone();
        let outcomes = OutcomePublisher::declare(network, &name).await?;
        let collector = Collector::start(network, &run, labels).await?;
        let follower = match &self.follow_verifier {
            Some(name) => Some(VerifierSubscriber::declare(network, name).await?),
            None => None,
        };
        if follower.is_some() {
            eprintln!("verifiers are awaited at {}", network.listening().join(", "));
        }
        let verifier = match (&follower, verifier) {
            (Some(follower), None) => self.first_verifier(follower, policy).await?,
            (_, named) => named,
        };
        let updates = follower.as_ref().map(|follower| {
            let mut latest = follower.latest();
            latest.mark_changed();
            latest
        });
        let done = run.summaries()?;
        let simulator = done.first().map(|summary| summary.simulator.clone());
        let mut rollout = Rollout {
            policy,
            verifier,
            updates,
            crew: Crew::new(network, local, policy.image_size(), &name, simulator, servers),
            sessions: self.sessions,
            keep: self.keep,
            stop: stop::listen()?,
            journal: Journal { progress: self.progress(&done, queue.len()), run, outcomes },
            queue,
        };
        rollout.run().await?;
        rollout.journal.progress.finish();
        let was_stopped = *rollout.stop.borrow() != Stop::No;
        collector.finish(&rollout.journal.run).await?;
        Ok(was_stopped)
    }

    /// A task that nobody offers would break every one of its episodes. Gives the number of servers.
    async fn check_tasks(&self, network: &Network) -> Result<usize> {
        let mut servers = network.servers(self.site.servers.max(1), SERVERS_WAIT).await;
        ensure!(!servers.is_empty(), "no server was to be seen at {:?}", self.site.connect);
        let offers = |server: &ServerDescription| {
            let is_offered = |task: &String| server.tasks.iter().any(|offer| offer.task == *task);
            self.suite.tasks.iter().all(is_offered)
        };
        if !servers.iter().any(offers) {
            // A fleet may have servers of other simulators, and one of them may have answered first.
            servers = network.servers(servers.len() + 1, OTHERS_WAIT).await;
        }
        let offered: BTreeSet<(&str, &str)> = servers
            .iter()
            .flat_map(|server| &server.tasks)
            .map(|offer| (offer.task.as_str(), offer.variant.as_str()))
            .collect();
        let is_missing = |task: &&String| !offered.contains(&(task.as_str(), VARIANT_DEFAULT));
        if let Some(task) = self.suite.tasks.iter().find(is_missing) {
            let words = |(task, variant): &(&str, &str)| format!("{task} ({variant})");
            let offered: Vec<String> = offered.iter().map(words).collect();
            let offered = offered.join(", ");
            bail!("task: expected one of {offered}, got {task} ({VARIANT_DEFAULT})");
        }
        Ok(servers.len())
    }

    fn progress(&self, done: &[EpisodeSummary], waiting: usize) -> Progress {
        let successes = done.iter().filter(|summary| summary.statistics.is_success).count();
        let total = done.len() + waiting;
        Progress::new(&self.title, total as u64, done.len() as u64, successes as u64)
    }

    /// The first one published that fits the policy, where a strategy cannot begin without.
    async fn first_verifier(
        &self,
        follower: &VerifierSubscriber,
        policy: &Policy,
    ) -> Result<Option<Arc<Verifier>>> {
        if !self.settings.iter().any(|setting| setting.strategy.needs_verifier()) {
            return Ok(None);
        }
        let mut latest = follower.latest();
        let fitting = async {
            loop {
                let update = latest.borrow_and_update().clone();
                if let Some(update) = update {
                    match Verifier::from_bytes(&update.weights, policy.digest()) {
                        Ok(verifier) => return Ok(Some(Arc::new(verifier))),
                        Err(error) => {
                            tracing::warn!("the verifier {} is ignored: {error:#}", update.name);
                        }
                    }
                }
                latest.changed().await.context("the network is closed")?;
            }
        };
        let secs = VERIFIER_WAIT.as_secs();
        tokio::time::timeout(VERIFIER_WAIT, fitting)
            .await
            .with_context(|| format!("no verifier for this policy was published within {secs} s"))?
    }

    fn report(&self, folder: &Path, plans: &[EpisodePlan], was_stopped: bool) -> Result<Report> {
        let (header, summaries) = (run::read_header(folder)?, run::summaries(folder)?);
        // The run may hold settings that this campaign did not ask for.
        let missing = Queue::new(&header.run, plans, &self.settings, &run::recorded(folder)?).len();
        let mut versions = header.versions;
        let simulator = summaries.first().map(|summary| summary.simulator.as_str());
        versions["simulator"] = json!(simulator);
        Ok(Report {
            folder: folder.to_path_buf(),
            results: Results::new(&summaries, &run::faults(folder)?)?,
            versions,
            missing,
            planned: plans.len() * self.settings.len(),
            was_stopped,
        })
    }
}

/// What a rollout is made of, before there is a network.
struct Stage<'a> {
    policy: &'a Policy,
    verifier: Option<Arc<Verifier>>,
    run: Run,
    queue: Queue,
    labels: LabelStore,
}
