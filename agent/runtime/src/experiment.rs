//! One run from beginning to end: servers, rollouts, records, labels.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use decision::{Decider, Policy, PolicyInfo, Scorer, Setting, TaskId, VARIANT_DEFAULT};
use protocol::VerifierUpdate;
use store::plan::EpisodePlan;
use store::queue::{EpisodeQueue, GivenUp, RunQueue};
use store::record::Versions;
use store::run::{self, Run};
use tokio::runtime::Runtime;
use tokio::sync::watch;

use crate::rollout::{RecordOptions, Rollout};
use crate::servers::Deployment;
use crate::sinks::{EventSink, OutcomeSink, Progress, Sinks, StoreSink, VideoSink};
use crate::stop::{self, Stop};
use crate::wire::{Fleet, OutcomePublisher, PoolOptions, VerifierSubscriber, ZenohPool};

/// After some of them have been found: a fleet may have servers of other tasks, which answered first.
const OTHERS_WAIT: Duration = Duration::from_secs(2);
/// A run that needs a verifier and follows one waits this long for the first.
const VERIFIER_WAIT: Duration = Duration::from_secs(60);
/// A run that had sessions waits this long for one to come back: a router or a machine may be started again.
const SESSION_WAIT: Duration = Duration::from_secs(600);
/// A run that never had a session gives up earlier.
const FIRST_SESSION_WAIT: Duration = Duration::from_secs(60);

/// Makes a scorer of a published verifier, or says why it does not fit the policy.
pub type LoadScorer = Arc<dyn Fn(&VerifierUpdate) -> Result<Arc<dyn Scorer>> + Send + Sync>;

/// What to run, where, and what to keep.
pub struct Experiment {
    /// The command's name, in progress lines.
    pub title: String,
    /// Which episodes.
    pub plans: Vec<EpisodePlan>,
    /// How each of them is run.
    pub settings: Vec<Setting>,
    /// Proposes candidates.
    pub policy: Arc<dyn Policy>,
    /// Scores them, where there is a scorer.
    pub scorer: Option<Arc<dyn Scorer>>,
    /// The name of a published verifier whose newest version is taken up between episodes.
    pub follow_verifier: Option<(String, LoadScorer)>,
    /// Episodes at once.
    pub sessions: usize,
    /// What records hold.
    pub record: RecordOptions,
    /// What records say they were made with.
    pub versions: Versions,
}

/// What became of an experiment.
#[derive(Debug)]
pub struct Ending {
    /// Episodes without a record.
    pub missing: usize,
    /// Episodes altogether.
    pub planned: usize,
    /// Episodes that will not be run again, with their reasons.
    pub given_up: Vec<GivenUp>,
    /// Whether somebody stopped it.
    pub was_stopped: bool,
}

impl Ending {
    /// An error when some episode has no outcome, for a partial result must not pass for a whole one.
    pub fn ensure_complete(&self, folder: &Path) -> Result<()> {
        if self.missing == 0 {
            return Ok(());
        }
        let why = if self.was_stopped { "stopped" } else { "faults" };
        bail!(
            "{why}: {} of {} episodes incomplete; rerun the same command to resume {}",
            self.missing,
            self.planned,
            folder.display()
        )
    }
}

impl Experiment {
    /// Runs what is not recorded yet in `run`, on servers that are only started where something is missing. Blocks.
    pub fn run(
        &self,
        run: Run,
        runtime: &Runtime,
        deploy: impl FnOnce() -> Result<Deployment>,
    ) -> Result<Ending> {
        self.check()?;
        let (folder, name) = (run.folder.clone(), run.header.run.clone());
        let recorded = run::recorded(&folder)?;
        let queue = RunQueue::new(&name, &self.plans, &self.settings, &recorded);
        let queue = Arc::new(queue);
        let mut was_stopped = false;
        if runtime.block_on(queue.progress())?.waiting > 0 {
            let deployment = deploy()?;
            let result = runtime.block_on(self.roll_out(&deployment, run, Arc::clone(&queue)));
            let closed = deployment.close(runtime);
            was_stopped = result.with_context(|| {
                format!("rerun the same command to resume {}", folder.display())
            })?;
            closed?;
        }
        let planned = self.plans.len() * self.settings.len();
        let given_up = runtime.block_on(queue.given_up())?;
        // The run may hold settings that this experiment did not ask for.
        let rest = RunQueue::new(&name, &self.plans, &self.settings, &run::recorded(&folder)?);
        let missing = runtime.block_on(rest.progress())?.waiting;
        Ok(Ending { missing, planned, given_up, was_stopped })
    }

    fn check(&self) -> Result<()> {
        ensure!(!self.settings.is_empty(), "strategies: expected at least one, got none");
        ensure!(self.sessions > 0, "sessions: expected at least 1, got 0");
        let needing = self.settings.iter().find(|setting| setting.strategy.needs_verifier());
        if let (Some(setting), None, None) = (needing, &self.scorer, &self.follow_verifier) {
            bail!("strategy {}: expected a verifier (--verifier FILE), got none", setting.strategy);
        }
        Ok(())
    }

    /// True when somebody stopped it.
    async fn roll_out(
        &self,
        deployment: &Deployment,
        run: Run,
        queue: Arc<RunQueue>,
    ) -> Result<bool> {
        let network = &deployment.network;
        self.check_tasks(deployment).await?;
        let name = run.header.run.clone();
        let (scorer, _following) = self.scorers(deployment).await?;
        let summaries = run.summaries()?;
        let simulator = summaries.first().map(|summary| summary.simulator.clone());
        let successes = summaries.iter().filter(|one| one.statistics.is_success).count();
        let waiting = queue.progress().await?.waiting;
        let done = summaries.len() as u64;
        let progress = Progress::new(&self.title, done + waiting as u64, done, successes as u64);
        let outcomes = OutcomePublisher::declare(network, &name).await?;
        let mut sinks: Vec<Box<dyn EventSink>> = Vec::new();
        if self.record.video {
            sinks.push(Box::new(VideoSink::new(run.folder.clone())));
        }
        sinks.push(Box::new(StoreSink::new(run)));
        sinks.push(Box::new(OutcomeSink::new(outcomes)));
        sinks.push(Box::new(progress));
        let pool = pool_options(self.policy.info(), name, simulator);
        let stop = stop::listen()?;
        let rollout = Rollout {
            decider: Arc::new(Decider::new(Arc::clone(&self.policy))),
            scorer,
            pool: ZenohPool::new(network.clone(), deployment.local.clone(), pool),
            queue: queue as Arc<dyn EpisodeQueue>,
            sinks: Sinks::start(sinks)?,
            sessions: self.sessions,
            options: self.record,
            versions: self.versions.clone(),
            stop: stop.clone(),
        };
        rollout.run().await?;
        Ok(*stop.borrow() != Stop::No)
    }

    /// A task that nobody offers would break every one of its episodes.
    async fn check_tasks(&self, deployment: &Deployment) -> Result<()> {
        let wanted: BTreeSet<&TaskId> = self.plans.iter().map(|plan| &plan.task).collect();
        let mut fleet = deployment.first_servers().await?;
        if !wanted.is_subset(&offered(&fleet).iter().collect()) {
            fleet = deployment.network.servers(fleet.servers.len() + 1, OTHERS_WAIT).await;
        }
        let offered = offered(&fleet);
        if let Some(task) = wanted.into_iter().find(|task| !offered.contains(*task)) {
            let offered: Vec<String> = offered.iter().map(TaskId::to_string).collect();
            bail!("task: expected one of {}, got {task}", offered.join(", "));
        }
        Ok(())
    }

    /// The scorer of now and those that are published later, and what must live for that.
    async fn scorers(
        &self,
        deployment: &Deployment,
    ) -> Result<(Scorers, Option<VerifierSubscriber>)> {
        let Deployment { network, source, .. } = deployment;
        let (sender, scorers) = watch::channel(self.scorer.clone());
        let Some((name, load)) = &self.follow_verifier else { return Ok((scorers, None)) };
        let follower = VerifierSubscriber::declare(network, name).await?;
        let listening = network.listening();
        let places = if listening.is_empty() { &source.connect[..] } else { listening };
        eprintln!("waiting for versions of verifier {name} at {}", places.join(", "));
        let mut latest = follower.latest();
        latest.mark_changed();
        tokio::spawn(follow(latest, Arc::clone(load), sender));
        let is_needed = self.settings.iter().any(|setting| setting.strategy.needs_verifier());
        if is_needed && self.scorer.is_none() {
            let mut first = scorers.clone();
            let first = first.wait_for(Option::is_some);
            let secs = VERIFIER_WAIT.as_secs();
            tokio::time::timeout(VERIFIER_WAIT, first)
                .await
                .with_context(|| {
                    format!("no version of verifier {name} for this policy was published within {secs} s")
                })?
                .context("the network is closed")?;
        }
        Ok((scorers, Some(follower)))
    }
}

type Scorers = watch::Receiver<Option<Arc<dyn Scorer>>>;

/// Takes up every published version that fits the policy.
async fn follow(
    mut latest: watch::Receiver<Option<Arc<VerifierUpdate>>>,
    load: LoadScorer,
    scorers: watch::Sender<Option<Arc<dyn Scorer>>>,
) {
    while latest.changed().await.is_ok() {
        let Some(update) = latest.borrow_and_update().clone() else { continue };
        match load(&update) {
            Ok(scorer) => {
                let digest = scorer.digest().get(..12).unwrap_or_default().to_owned();
                eprintln!("verifier {} is now {digest}", update.name);
                scorers.send_replace(Some(scorer));
            }
            Err(error) => tracing::warn!("the verifier {} is ignored: {error:#}", update.name),
        }
    }
}

/// How the sessions of a run are opened for a policy.
pub fn pool_options(policy: &PolicyInfo, holder: String, simulator: Option<String>) -> PoolOptions {
    PoolOptions {
        image_size: policy.image_size,
        action_length: policy.action_space.length(),
        holder,
        simulator,
        first_wait: FIRST_SESSION_WAIT,
        wait: SESSION_WAIT,
    }
}

/// The tasks that servers offer in their default variant, in the order of their descriptions.
pub async fn default_tasks(deployment: &Deployment) -> Result<Vec<TaskId>> {
    let fleet = deployment.first_servers().await?;
    let mut tasks: Vec<TaskId> = Vec::new();
    for offer in fleet.servers.values().flat_map(|server| &server.tasks) {
        let task = TaskId::new(&offer.task, &offer.variant);
        if task.variant == VARIANT_DEFAULT && !tasks.contains(&task) {
            tasks.push(task);
        }
    }
    ensure!(!tasks.is_empty(), "tasks: expected --tasks, for no server offers a default variant");
    Ok(tasks)
}

/// Every task in every variant that some server offers.
fn offered(fleet: &Fleet) -> BTreeSet<TaskId> {
    let tasks = fleet.servers.values().flat_map(|server| &server.tasks);
    tasks.map(|offer| TaskId::new(&offer.task, &offer.variant)).collect()
}

impl std::fmt::Debug for Experiment {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Experiment").field("title", &self.title).finish_non_exhaustive()
    }
}
