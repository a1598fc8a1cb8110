//! Whole episodes, many at once: policy, verifier, wire and simulators together.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde::Serialize;
use serde_json::json;
use tokio::sync::watch;

use vla::Vla;
use runtime::progress::{Counts, Progress};
use runtime::rollout::{Crew, Journal, Keep, Rollout};
use store::queue::Queue;
use store::run::Run;
use runtime::servers::LocalServers;
use runtime::site::Site;
use runtime::stop::Stop;
use decision::Strategy;
use decision::Setting;
use evaluation::suite::{Layouts, Suite, TASKS};
use store::plan::SeedRange;
use verifier::Verifier;
use runtime::wire::{Network, OutcomePublisher};

/// Control steps of every session before any is counted.
const WARM_UP_STEPS: u64 = 10;
/// The shortest episode: so many decisions need at most as many episodes as this says.
const HORIZON_MIN: u64 = 60;
/// Local servers are on the network already.
const SERVERS_WAIT: Duration = Duration::from_secs(30);

/// One number of sessions.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// Episodes at once.
    pub sessions: usize,
    /// Counted.
    pub decisions: u64,
    /// Every one of them a control step with its image.
    pub decisions_per_second: f64,
    /// Finished, recorded and published.
    pub episodes_per_second: f64,
    /// Resident memory of this process when counting began, in MB.
    pub memory_mb_before: f64,
    /// And when it ended.
    pub memory_mb_after: f64,
}

/// What is timed.
pub struct ThroughputBench<'a> {
    /// Proposes.
    pub policy: &'a Policy,
    /// Scores.
    pub verifier: Arc<Verifier>,
    /// Where the servers are started.
    pub site: &'a Site,
    /// Numbers of episodes at once.
    pub sessions: &'a [usize],
    /// Counted for each of them.
    pub decisions: u64,
    /// Per decision.
    pub candidates: u32,
}

impl ThroughputBench<'_> {
    /// Runs episodes on random layouts of the tuning range; what they come to is thrown away.
    pub fn run(&self) -> Result<Vec<Row>> {
        ensure!(self.decisions > 0, "decisions: expected at least 1, got 0");
        ensure!(!self.sessions.contains(&0), "sessions: expected at least 1, got 0");
        let most = self.sessions.iter().copied().max().context("sessions: expected some")?;
        let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
        self.site.run(&runtime, most, async |network, local| {
            let mut rows = Vec::new();
            for &sessions in self.sessions {
                rows.push(self.count(network, local, sessions).await?);
            }
            Ok(rows)
        })
    }

    async fn count(
        &self,
        network: &Network,
        local: Option<&LocalServers>,
        sessions: usize,
    ) -> Result<Row> {
        let folder = tempfile::tempdir().context("cannot make a folder")?;
        let servers = network.servers(self.site.servers, SERVERS_WAIT).await.len();
        let title = format!("{sessions} sessions");
        let run = Run::open(folder.path(), json!({ "bench": "throughput" }), json!({}))?;
        let name = run.header.run.clone();
        let warm_up = WARM_UP_STEPS * sessions as u64;
        let queue = self.queue(&name, warm_up + self.decisions, sessions);
        let progress = Progress::new(&title, queue.len() as u64, 0, 0);
        let counts = progress.counts();
        let (_never, stop) = watch::channel(Stop::No);
        let outcomes = OutcomePublisher::declare(network, &name).await?;
        let mut rollout = Rollout {
            policy: self.policy,
            verifier: Some(Arc::clone(&self.verifier)),
            updates: None,
            crew: Crew::new(network, local, self.policy.image_size(), &name, None, servers),
            sessions,
            keep: Keep { all_hidden: false, video: false },
            stop,
            journal: Journal { progress, run, outcomes },
            queue,
        };
        let watched = watch_window(counts, warm_up, self.decisions);
        tokio::pin!(watched);
        let window = tokio::select! {
            window = &mut watched => window?,
            // The last of its steps may be seen after the last episode has ended.
            result = rollout.run() => { result?; watched.await? }
        };
        rollout.journal.progress.finish();
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

    /// Episodes enough that no session is idle before so many decisions are made.
    fn queue(&self, run: &str, decisions: u64, sessions: usize) -> Queue {
        let episodes = (decisions / HORIZON_MIN) as usize + 2 * sessions;
        let suite = Suite {
            tasks: TASKS.map(str::to_owned).to_vec(),
            episodes: episodes.div_ceil(TASKS.len()) as u32,
            layouts: Layouts::Random,
            range: SeedRange::Tuning,
            seed: 0,
        };
        let setting = Setting::new(Strategy::Verifier, self.candidates, 1.0);
        Queue::new(run, &suite.episodes(), &[setting], &BTreeSet::new())
    }
}

/// What happened between two moments.
struct Window {
    counts: Counts,
    elapsed: Duration,
    memory_mb_before: f64,
    memory_mb_after: f64,
}

/// Waits until `warm_up` steps are done, then for `decisions` more.
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

/// Resident memory of this process.
fn resident_mb() -> Result<f64> {
    let status = std::fs::read_to_string("/proc/self/status").context("cannot read /proc")?;
    let kilobytes = status
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))
        .and_then(|rest| rest.split_whitespace().next()?.parse::<f64>().ok())
        .context("/proc/self/status: expected a line VmRSS")?;
    Ok(kilobytes / 1e3)
}
