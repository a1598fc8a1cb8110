//! Times concurrent episodes: policy, verifier, wire and simulators together.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use decision::{Decider, Policy, Scorer, Setting, Strategy};
use evaluation::suite::{Layouts, Suite};
use runtime::experiment::{default_tasks, pool_options};
use runtime::rollout::{RecordOptions, Rollout};
use runtime::servers::{Deployment, ServerSource};
use runtime::sinks::{Counts, OutcomeSink, Progress, Sinks, StoreSink};
use runtime::stop::Stop;
use runtime::wire::{OutcomePublisher, ZenohPool};
use serde::Serialize;
use serde_json::json;
use store::plan::{OfferedTask, SeedRange};
use store::queue::{EpisodeQueue, RunQueue};
use store::run::{Run, RunRequest};
use tokio::sync::watch;
use verifier::Verifier;

use super::decision::compared;
use crate::build_info;

/// Control steps per session before counting starts.
const WARM_UP_STEPS: u64 = 10;
/// Length of the shortest episode, for an upper bound on the episodes that a number of decisions needs.
const HORIZON_MIN: u64 = 60;
/// The results for one number of concurrent episodes.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// Concurrent episodes.
    pub sessions: usize,
    /// Counted decisions.
    pub decisions: u64,
    /// Counted decisions per second. Each includes a control step with its image.
    pub decisions_per_second: f64,
    /// Episodes per second that were finished, recorded and published.
    pub episodes_per_second: f64,
    /// Resident memory of this process when counting started, in MB.
    pub memory_mb_before: f64,
    /// Resident memory of this process when counting ended, in MB.
    pub memory_mb_after: f64,
}

/// The parameters of the benchmark.
pub struct ThroughputBench<'a> {
    /// The policy that proposes candidates.
    pub policy: Arc<dyn Policy>,
    /// The verifier that scores them, if there is one; without it the medoid is executed.
    pub verifier: Option<Arc<Verifier>>,
    /// Source of the local servers.
    pub servers: &'a ServerSource,
    /// Numbers of concurrent episodes.
    pub sessions: &'a [usize],
    /// Decisions to count for each of these numbers.
    pub decisions: u64,
    /// Candidates per decision.
    pub candidates: u32,
}

impl ThroughputBench<'_> {
    /// Runs episodes on random layouts of the tuning range. Their records are deleted.
    pub fn run(&self) -> Result<Vec<Row>> {
        ensure!(self.decisions > 0, "decisions: expected at least 1, got 0");
        ensure!(!self.sessions.contains(&0), "sessions: expected at least 1, got 0");
        let most = self.sessions.iter().copied().max().context("sessions: expected some")?;
        let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
        let deployment = self.servers.open(&runtime, most)?;
        let rows = runtime.block_on(self.rows(&deployment));
        deployment.close(&runtime)?;
        rows
    }

    async fn rows(&self, deployment: &Deployment) -> Result<Vec<Row>> {
        let tasks = default_tasks(deployment).await?;
        let mut rows = Vec::new();
        for &sessions in self.sessions {
            rows.push(self.count(deployment, &tasks, sessions).await?);
        }
        Ok(rows)
    }

    async fn count(
        &self,
        deployment: &Deployment,
        tasks: &[OfferedTask],
        sessions: usize,
    ) -> Result<Row> {
        let folder = tempfile::tempdir().context("cannot create a temporary folder")?;
        let title = format!("{sessions} sessions");
        let run = Run::open(&RunRequest {
            folder: folder.path().to_path_buf(),
            options: json!({ "bench": "throughput" }),
            build: build_info::build(),
            ..RunRequest::default()
        })?;
        let name = run.header.run.clone();
        let warm_up = WARM_UP_STEPS * sessions as u64;
        let queue = self.queue(&name, tasks, warm_up + self.decisions, sessions)?;
        let waiting = queue.progress().await?.waiting as u64;
        let steps: f64 = tasks.iter().map(|task| f64::from(task.steps_max)).sum();
        let progress = Progress::new(&title, waiting, steps / tasks.len().max(1) as f64);
        let counts = progress.counts();
        let (_never, stop) = watch::channel(Stop::No);
        let outcomes = OutcomePublisher::declare(&deployment.network, &name).await?;
        let (_newer, scorer) = watch::channel(self.scorer());
        let policy = Arc::clone(&self.policy);
        let pool = pool_options(policy.info(), name, None);
        let rollout = Rollout {
            decider: Arc::new(Decider::new(policy)),
            scorer,
            pool: ZenohPool::new(deployment.network.clone(), deployment.local.clone(), pool),
            queue: Arc::new(queue),
            sinks: Sinks::start(vec![
                Box::new(StoreSink::new(run)),
                Box::new(OutcomeSink::new(outcomes)),
                Box::new(progress.silent()),
            ])?,
            sessions,
            options: RecordOptions::default(),
            // Random weights are timed, too.
            needs_well_formed: false,
            versions: build_info::record_versions(),
            stop,
        };
        let watched = watch_window(counts, warm_up, self.decisions);
        tokio::pin!(watched);
        let window = tokio::select! {
            window = &mut watched => window?,
            // The last steps may be observed only after the last episode has ended.
            result = rollout.run() => { result?; watched.await? }
        };
        let secs = window.elapsed.as_secs_f64();
        Ok(Row {
            sessions,
            decisions: window.counts.steps,
            decisions_per_second: window.counts.steps as f64 / secs,
            episodes_per_second: window.counts.episodes as f64 / secs,
            memory_mb_before: window.memory_mb_before,
            memory_mb_after: window.memory_mb_after,
        })
    }

    fn scorer(&self) -> Option<Arc<dyn Scorer>> {
        self.verifier.clone().map(|verifier| verifier as Arc<dyn Scorer>)
    }

    /// The strategy that is timed: it compares all candidates.
    pub fn strategy(&self) -> Strategy {
        compared(self.verifier.is_some())
    }

    /// A queue with enough episodes that no session is idle before this many decisions are made.
    fn queue(
        &self,
        run: &str,
        tasks: &[OfferedTask],
        decisions: u64,
        sessions: usize,
    ) -> Result<RunQueue> {
        let episodes = (decisions / HORIZON_MIN) as usize + 2 * sessions;
        let suite = Suite {
            tasks: tasks.to_vec(),
            episodes: episodes.div_ceil(tasks.len()) as u32,
            layouts: Layouts::Random,
            range: SeedRange::Tuning,
            seed: 0,
        };
        let setting = Setting::new(self.strategy(), self.candidates, 1.0);
        Ok(RunQueue::new(run, &suite.episodes()?, &[setting], &BTreeSet::new()))
    }
}

/// The counts of one measurement period.
struct Window {
    counts: Counts,
    elapsed: Duration,
    memory_mb_before: f64,
    memory_mb_after: f64,
}

/// Waits until `warm_up` steps are done, then counts `decisions` more.
async fn watch_window(
    mut counts: watch::Receiver<Counts>,
    warm_up: u64,
    decisions: u64,
) -> Result<Window> {
    let gone = "the rollout ended before enough decisions were made";
    let first = *counts.wait_for(|counts| counts.steps >= warm_up).await.context(gone)?;
    let (begun, memory_mb_before) = (Instant::now(), resident_mb()?);
    let goal = first.steps + decisions;
    let last = *counts.wait_for(|counts| counts.steps >= goal).await.context(gone)?;
    Ok(Window {
        counts: Counts {
            steps: last.steps - first.steps,
            episodes: last.episodes - first.episodes,
        },
        elapsed: begun.elapsed(),
        memory_mb_before,
        memory_mb_after: resident_mb()?,
    })
}

/// Resident memory of this process, in MB.
fn resident_mb() -> Result<f64> {
    let status = std::fs::read_to_string("/proc/self/status").context("cannot read /proc")?;
    let kilobytes = status
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))
        .and_then(|rest| rest.split_whitespace().next()?.parse::<f64>().ok())
        .context("/proc/self/status: expected a VmRSS line")?;
    Ok(kilobytes / 1e3)
}
