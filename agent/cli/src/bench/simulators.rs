//! Compares the Python and the native simulator: control steps per second over the wire, with and without an image.

use std::time::Duration;

use anyhow::{Context, Result, ensure};
use decision::TaskId;
use serde::Serialize;

use super::wire::{EPISODE_STEPS, WARM_UP_STEPS, at_once, circling, default_tasks, open, reset};
use evaluation::statistics::quantile;
use runtime::servers::{LocalServers, LocalSource, Missing, ServerSource, Simulator};
use runtime::wire::{Environment, Episode, Network};

/// How long to wait for the local servers to be found. They have joined the network already.
const SERVERS_WAIT: Duration = Duration::from_secs(30);
/// The image size at which nothing is rendered.
const SIDE_NONE: u32 = 0;

/// The results for one image size and one number of concurrent sessions.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// Height and width of the image; 0 without one.
    pub side: u32,
    /// Sessions of each server.
    pub sessions: usize,
    /// Counted steps of each server.
    pub steps: usize,
    /// Control steps per second of the Python server, from its median step time.
    pub python_steps_per_second: f64,
    /// Control steps per second of the native server, from its median step time.
    pub native_steps_per_second: f64,
}

/// The parameters of the benchmark.
pub struct SimulatorsBench<'a> {
    /// Source of the local servers; its `simulator` is ignored.
    pub servers: &'a ServerSource,
    /// Numbers of sessions.
    pub sessions: &'a [usize],
    /// Control steps of every session.
    pub steps: usize,
    /// Height and width of the image in pixels.
    pub side: u32,
}

impl SimulatorsBench<'_> {
    /// Starts one server of each simulator and measures them alternately, step by step.
    pub fn run(&self) -> Result<Vec<Row>> {
        ensure!(self.steps > 0, "steps: expected at least 1, got 0");
        ensure!(!self.sessions.contains(&0), "sessions: expected at least 1, got 0");
        let most = self.sessions.iter().copied().max().context("sessions: expected some")?;
        let local = self.servers.local.as_ref().context("servers: expected some to start")?;
        let programs = [Simulator::Python, Simulator::Native]
            .map(|simulator| LocalSource { simulator, ..local.clone() }.program(Missing::Install));
        let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
        let network = runtime.block_on(Network::open(self.servers.network_options()))?;
        let mut servers = Vec::new();
        for program in programs {
            servers.push(self.servers.start(program?, &network, most)?);
        }
        let rows = runtime.block_on(self.rows(&network, &servers, most));
        // Servers are stopped first. They would report a closed network as an error.
        drop(servers);
        runtime.block_on(network.close())?;
        rows
    }

    async fn rows(
        &self,
        network: &Network,
        servers: &[LocalServers],
        most: usize,
    ) -> Result<Vec<Row>> {
        network.servers(servers.len(), SERVERS_WAIT).await;
        let mut rows = Vec::new();
        for side in [SIDE_NONE, self.side] {
            let (mut both, mut tasks) = (Vec::new(), Vec::new());
            for server in servers {
                let id = server.server_ids().pop().context("a local server is not ready")?;
                tasks = default_tasks(network, &id).await?;
                let mut environments = Vec::new();
                for index in 0..most {
                    environments.push(open(network, &id, &tasks, side, index).await?);
                }
                both.push(environments);
            }
            for &sessions in self.sessions {
                let rests: Vec<_> = both.iter_mut().map(|all| all.split_off(sessions)).collect();
                let (row, used) = self.count(side, both, &tasks).await?;
                rows.push(row);
                both = used;
                both.iter_mut().zip(rests).for_each(|(all, rest)| all.extend(rest));
            }
            for environment in both.into_iter().flatten() {
                environment.close().await?;
            }
        }
        Ok(rows)
    }

    async fn count(
        &self,
        side: u32,
        both: Vec<Vec<Environment>>,
        tasks: &[TaskId],
    ) -> Result<(Row, Vec<Vec<Environment>>)> {
        let sessions = both[0].len();
        let mut episodes = Vec::new();
        for environments in both {
            episodes.push(reset(environments, tasks).await?);
        }
        let mut times = vec![Vec::new(); episodes.len()];
        for index in 0..WARM_UP_STEPS + self.steps {
            let is_over = index % EPISODE_STEPS == EPISODE_STEPS - 1;
            let mut after = Vec::new();
            for (mut own, times) in episodes.into_iter().zip(&mut times) {
                if is_over {
                    own = reset(own.into_iter().map(Episode::finish).collect(), tasks).await?;
                }
                let (step_ms, own) = at_once(own, |mut episode: Episode| async move {
                    episode.step(&circling(index)).await.map(|_| episode)
                })
                .await?;
                if index >= WARM_UP_STEPS {
                    times.push(step_ms);
                }
                after.push(own);
            }
            episodes = after;
        }
        let per_second = |times: &mut Vec<f64>| {
            times.sort_by(f64::total_cmp);
            1e3 / quantile(times, 0.5)
        };
        let row = Row {
            side,
            sessions,
            steps: self.steps * sessions,
            python_steps_per_second: per_second(&mut times[0]),
            native_steps_per_second: per_second(&mut times[1]),
        };
        let finish = |own: Vec<Episode>| own.into_iter().map(Episode::finish).collect();
        Ok((row, episodes.into_iter().map(finish).collect()))
    }
}
