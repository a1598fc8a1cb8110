//! One run from beginning to end: servers, rollouts, records, labels.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use decision::{Decider, Policy, PolicyInfo, Scorer, Setting, TaskId, VARIANT_DEFAULT};
use protocol::VerifierUpdate;
use store::plan::{EpisodePlan, OfferedTask};
use store::queue::{EpisodeQueue, GivenUp, RunQueue};
use store::record::Versions;
use store::run::{self, Run};
use thiserror::Error;
use tokio::runtime::Runtime;
use tokio::sync::watch;

use crate::rollout::{NeverWellFormed, RecordOptions, Rollout};
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
    /// Whether to show neither where the run stands nor its progress.
    pub is_quiet: bool,
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
        let (missing, planned, folder) = (self.missing, self.planned, folder.display());
        let text = format!(
            "{missing} of {planned} episodes incomplete; rerun the same command to resume {folder}"
        );
        if self.was_stopped {
            bail!(Stopped(text));
        }
        let given_up: String = self.given_up.iter().map(|one| format!("\n{one}")).collect();
        bail!("faults: {text}{given_up}")
    }
}

/// Somebody stopped the run before it was complete.
#[derive(Debug, Error)]
#[error("stopped: {0}")]
pub struct Stopped(String);

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
        let waiting = runtime.block_on(queue.progress())?.waiting;
        self.announce(&folder, waiting);
        if waiting > 0 {
            let deployment = deploy()?;
            let result = runtime.block_on(self.roll_out(&deployment, run, Arc::clone(&queue)));
            let closed = deployment.close(runtime);
            was_stopped = result.map_err(|error| match error.is::<NeverWellFormed>() {
                // The same command would end in the same way.
                true => error,
                false => {
                    error.context(format!("rerun the same command to resume {}", folder.display()))
                }
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

    /// Says which run this is, and what of it there is already.
    fn announce(&self, folder: &Path, waiting: usize) {
        if self.is_quiet {
            return;
        }
        let planned = self.plans.len() * self.settings.len();
        let (folder, recorded) = (folder.display(), planned.saturating_sub(waiting));
        match (recorded, waiting) {
            (_, 0) => {
                eprintln!("run {folder}: all {planned} episodes are recorded, nothing to run")
            }
            (0, _) => eprintln!("run {folder}: {planned} episodes"),
            _ => eprintln!("run {folder}: resuming, {recorded} of {planned} episodes are recorded"),
        }
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

    /// Control steps of an episode at most, on average over the plans: what there is to estimate from at the start.
    fn steps_expected(&self, offered: &[OfferedTask]) -> f64 {
        let steps = |plan: &EpisodePlan| {
            let task = offered.iter().find(|task| task.id == plan.task);
            task.map_or(0.0, |task| f64::from(task.steps_max))
        };
        self.plans.iter().map(steps).sum::<f64>() / self.plans.len().max(1) as f64
    }

    /// True when somebody stopped it.
    async fn roll_out(
        &self,
        deployment: &Deployment,
        run: Run,
        queue: Arc<RunQueue>,
    ) -> Result<bool> {
        let network = &deployment.network;
        let wanted: BTreeSet<&TaskId> = self.plans.iter().map(|plan| &plan.task).collect();
        let is_offered = |offered: &[OfferedTask]| {
            wanted.iter().all(|id| offered.iter().any(|task| task.id == **id))
        };
        let offered = offered_tasks(deployment, is_offered).await?;
        ensure!(
            is_offered(&offered),
            "tasks: expected servers that offer {}, got servers of {}",
            names(wanted.into_iter()),
            names(offered.iter().map(|task| &task.id))
        );
        let name = run.header.run.clone();
        let (scorer, _following) = self.scorers(deployment).await?;
        let summaries = run.summaries()?;
        let simulator = summaries.first().map(|summary| summary.simulator.clone());
        let waiting = queue.progress().await?.waiting as u64;
        let mut progress = Progress::new(&self.title, waiting, self.steps_expected(&offered));
        for summary in summaries.iter().filter(|one| one.has_outcome()) {
            progress.recorded_before(&summary.identity, summary.statistics.is_success);
        }
        if !self.is_quiet {
            let (servers, sessions) = (network.fleet().borrow().servers.len(), self.sessions);
            eprintln!("{servers} environment servers, up to {sessions} episodes at once");
        }
        let outcomes = OutcomePublisher::declare(network, &name).await?;
        let mut sinks: Vec<Box<dyn EventSink>> = Vec::new();
        if self.record.video {
            sinks.push(Box::new(VideoSink::new(run.folder.clone())));
        }
        sinks.push(Box::new(StoreSink::new(run)));
        sinks.push(Box::new(OutcomeSink::new(outcomes)));
        if self.is_quiet {
            sinks.push(Box::new(progress.silent()));
        } else {
            sinks.push(Box::new(progress));
        }
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
            needs_well_formed: true,
            versions: self.versions.clone(),
            stop: stop.clone(),
        };
        rollout.run().await?;
        Ok(*stop.borrow() != Stop::No)
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

/// The tasks of the servers that are found in time: of more servers than the first where `is_enough` says that these do not
/// suffice.
pub async fn offered_tasks(
    deployment: &Deployment,
    is_enough: impl Fn(&[OfferedTask]) -> bool,
) -> Result<Vec<OfferedTask>> {
    let fleet = deployment.first_servers().await?;
    let offered = tasks_of(&fleet);
    if is_enough(&offered) {
        return Ok(offered);
    }
    Ok(tasks_of(&deployment.network.servers(fleet.servers.len() + 1, OTHERS_WAIT).await))
}

fn names<'a>(tasks: impl Iterator<Item = &'a TaskId>) -> String {
    tasks.map(TaskId::to_string).collect::<Vec<_>>().join(", ")
}

/// The tasks that servers offer in their default variant.
pub async fn default_tasks(deployment: &Deployment) -> Result<Vec<OfferedTask>> {
    let mut tasks = tasks_of(&deployment.first_servers().await?);
    tasks.retain(|task| task.id.variant == VARIANT_DEFAULT);
    ensure!(
        !tasks.is_empty(),
        "--tasks: expected TASK/VARIANT, because no server offers a default variant; `rever list variants` lists them"
    );
    Ok(tasks)
}

/// Each task in each variant once, in the order of the descriptions.
fn tasks_of(fleet: &Fleet) -> Vec<OfferedTask> {
    let mut tasks: Vec<OfferedTask> = Vec::new();
    for offer in fleet.servers.values().flat_map(|server| &server.tasks) {
        let id = TaskId::new(&offer.task, &offer.variant);
        if tasks.iter().all(|task| task.id != id) {
            tasks.push(OfferedTask { id, layouts: offer.layouts, steps_max: offer.steps_max });
        }
    }
    tasks
}

impl std::fmt::Debug for Experiment {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("Experiment").field("title", &self.title).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use store::record::EpisodeIdentity;

    use super::*;

    #[test]
    fn a_partial_result_names_the_episodes_that_were_given_up() {
        let identity = EpisodeIdentity {
            run: "run".to_owned(),
            task: "stack".to_owned(),
            variant: "default".to_owned(),
            layout: None,
            episode: 3,
            seed: 1,
            sampling_seed: 1,
            strategy: "sample".to_owned(),
            candidates: 1,
            temperature: 1.0,
        };
        let given_up = vec![GivenUp { identity, reasons: vec!["a".into(), "diverged".into()] }];
        let ending = Ending { missing: 1, planned: 4, given_up, was_stopped: false };
        let error = ending.ensure_complete(Path::new("run")).expect_err("it is partial");
        let error = error.to_string();
        assert!(error.starts_with("faults: 1 of 4 episodes incomplete"), "{error}");
        assert!(error.contains("stack-default-0003"), "{error}");
        assert!(error.ends_with("given up after 2 faults, the last one: diverged"), "{error}");
    }
}
