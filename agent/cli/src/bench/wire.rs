//! Measures the wire's share of a control step.
//!
//! A reply reports the time that the simulator took for the step. The rest of the round trip is the wire: the request,
//! queues, serializing the reply, transferring its image, deserializing it.
//!
//! Two baselines are measured alternately with the steps. A repeated reply needs no simulation and no serialization.
//! The same number of bytes through a bare socket shows how fast this machine is at that time.

use std::f32::consts::TAU;
use std::io::{Read, Result as IoResult, Write};
use std::os::unix::net::UnixStream;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use decision::{TaskId, VARIANT_DEFAULT};
use protocol::{Open, PROTOCOL_VERSION, Reset};
use serde::Serialize;
use tokio::task::JoinSet;

use evaluation::statistics::quantile;
use runtime::fault::EnvironmentFault;
use runtime::servers::{ServerSource, Simulator};
use runtime::wire::{Environment, Episode, Network};
use store::plan::SeedRange;

/// Steps before an episode is reset. No task has a shorter horizon.
pub(super) const EPISODE_STEPS: usize = 50;
/// Steps that are not counted, while caches fill.
pub(super) const WARM_UP_STEPS: usize = 5;
/// Control steps per circle of the gripper.
const ROUND_STEPS: f32 = 16.0;
/// Distance that the gripper moves per step, in metres: about as far as under the expert.
const STEP_LENGTH: f32 = 0.02;
/// How long to wait for the local server to be found. It has joined the network already.
pub(super) const SERVER_WAIT: Duration = Duration::from_secs(30);

/// Size of a serialized `Step`.
const REQUEST_BYTES: usize = 62;

/// The results for one number of concurrent sessions on one server.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// The server's simulator.
    pub simulator: Simulator,
    /// Sessions of the server.
    pub sessions: usize,
    /// Counted steps of all sessions.
    pub steps: usize,
    /// A control step with its image: the time of all sessions' steps divided by the number of sessions, median.
    pub step_ms_p50: f64,
    /// The simulator's part of it, as the server reports it: median of the sessions' means.
    pub simulator_ms_p50: f64,
    /// The rest of it, median.
    pub wire_ms_p50: f64,
    /// The same, 95th percentile.
    pub wire_ms_p95: f64,
    /// A repeated reply: the time of all sessions' replies divided by the number of sessions, median.
    pub repeat_ms_p50: f64,
    /// Size of a reply: median of the sessions' means.
    pub reply_bytes_p50: f64,
    /// The bytes of a request and a reply through a socket between two threads, median.
    pub bare_ms_p50: f64,
}

/// The parameters of the benchmark.
pub struct WireBench<'a> {
    /// Source of the local server.
    pub servers: &'a ServerSource,
    /// Numbers of sessions.
    pub sessions: &'a [usize],
    /// Control steps of every session.
    pub steps: usize,
    /// Height and width of the image in pixels.
    pub side: u32,
}

impl WireBench<'_> {
    /// Starts one server and measures each number of sessions.
    pub fn run(&self) -> Result<Vec<Row>> {
        ensure!(self.steps > 0, "steps: expected at least 1, got 0");
        ensure!(!self.sessions.contains(&0), "sessions: expected at least 1, got 0");
        let most = self.sessions.iter().copied().max().context("sessions: expected some")?;
        let runtime = tokio::runtime::Runtime::new().context("cannot start the async runtime")?;
        let deployment = self.servers.open(&runtime, most)?;
        let rows = runtime.block_on(self.rows(&deployment.network, most));
        deployment.close(&runtime)?;
        rows
    }

    async fn rows(&self, network: &Network, most: usize) -> Result<Vec<Row>> {
        let found = network.servers(1, SERVER_WAIT).await.servers;
        let server = found.keys().next().context("the local server was not found")?;
        let tasks = default_tasks(network, server).await?;
        let mut environments = Vec::new();
        for index in 0..most {
            environments.push(open(network, server, &tasks, self.side, index).await?);
        }
        let mut rows = Vec::new();
        for &sessions in self.sessions {
            let rest = environments.split_off(sessions);
            let (row, used) = self.count(environments, &tasks).await?;
            rows.push(row);
            environments = used;
            environments.extend(rest);
        }
        Ok(rows)
    }

    /// Measures steps and repeated replies of these sessions, alternately.
    async fn count(
        &self,
        environments: Vec<Environment>,
        tasks: &[TaskId],
    ) -> Result<(Row, Vec<Environment>)> {
        let sessions = environments.len();
        let mut socket = BareSocket::open().context("cannot open a socket")?;
        let [mut stepped, mut simulated, mut wire, mut repeated, mut sizes, mut bare] =
            [const { Vec::new() }; 6];
        let mut episodes = reset(environments, tasks).await?;
        for index in 0..WARM_UP_STEPS + self.steps {
            if index % EPISODE_STEPS == EPISODE_STEPS - 1 {
                episodes =
                    reset(episodes.into_iter().map(Episode::finish).collect(), tasks).await?;
            }
            let (step_ms, after) = at_once(episodes, |mut episode: Episode| async move {
                episode.step(&circling(index)).await.map(|_| episode)
            })
            .await?;
            let in_simulator = after.iter().map(Episode::simulator_time).sum::<Duration>();
            let simulator_ms = in_simulator.as_secs_f64() * 1e3 / sessions as f64;
            let (repeat_ms, after) = at_once(after, |mut episode: Episode| async move {
                episode.repeat().await.map(|()| episode)
            })
            .await?;
            let reply_bytes = after.iter().map(Episode::reply_bytes).sum::<usize>() / sessions;
            let bare_ms = socket.exchange(reply_bytes).context("the socket's peer is gone")?;
            if index >= WARM_UP_STEPS {
                stepped.push(step_ms);
                simulated.push(simulator_ms);
                wire.push(step_ms - simulator_ms);
                repeated.push(repeat_ms);
                sizes.push(reply_bytes as f64);
                bare.push(bare_ms);
            }
            episodes = after;
        }
        for figures in
            [&mut stepped, &mut simulated, &mut wire, &mut repeated, &mut sizes, &mut bare]
        {
            figures.sort_by(f64::total_cmp);
        }
        let local = self.servers.local.as_ref().context("servers: expected one to start")?;
        let row = Row {
            simulator: local.simulator,
            sessions,
            steps: self.steps * sessions,
            step_ms_p50: quantile(&stepped, 0.5),
            simulator_ms_p50: quantile(&simulated, 0.5),
            wire_ms_p50: quantile(&wire, 0.5),
            wire_ms_p95: quantile(&wire, 0.95),
            repeat_ms_p50: quantile(&repeated, 0.5),
            reply_bytes_p50: quantile(&sizes, 0.5),
            bare_ms_p50: quantile(&bare, 0.5),
        };
        Ok((row, episodes.into_iter().map(Episode::finish).collect()))
    }
}

/// An action that moves the gripper in circles above the table and opens and closes it. The image changes about as much
/// as in an episode.
pub(super) fn circling(step: usize) -> [f32; 7] {
    let angle = step as f32 * TAU / ROUND_STEPS;
    let (across, along) = angle.sin_cos();
    let gripper = if across < 0.0 { -1.0 } else { 1.0 };
    [STEP_LENGTH * along, STEP_LENGTH * across, 0.0, 0.0, 0.0, 0.0, gripper]
}

/// A socket to a thread that answers each request with the requested number of bytes. Dropping it ends the thread.
struct BareSocket {
    stream: UnixStream,
    reply: Vec<u8>,
}

impl BareSocket {
    fn open() -> IoResult<Self> {
        let (stream, mut other) = UnixStream::pair()?;
        thread::spawn(move || {
            let (mut request, mut reply) = ([0; REQUEST_BYTES], Vec::new());
            while other.read_exact(&mut request).is_ok() {
                let [a, b, c, d, ..] = request;
                reply.resize(u32::from_le_bytes([a, b, c, d]) as usize, 0);
                if other.write_all(&reply).is_err() {
                    break;
                }
            }
        });
        Ok(Self { stream, reply: Vec::new() })
    }

    /// Milliseconds of a request and a reply of this size. Blocks.
    fn exchange(&mut self, reply_bytes: usize) -> IoResult<f64> {
        self.reply.resize(reply_bytes, 0);
        let mut request = [0; REQUEST_BYTES];
        request[..4].copy_from_slice(&(reply_bytes as u32).to_le_bytes());
        let begun = Instant::now();
        self.stream.write_all(&request)?;
        self.stream.read_exact(&mut self.reply)?;
        Ok(begun.elapsed().as_secs_f64() * 1e3)
    }
}

/// The tasks of a server in their default variant, in the order of its description.
pub(super) async fn default_tasks(network: &Network, server: &str) -> Result<Vec<TaskId>> {
    let description = network.describe(server).await?;
    let tasks = description.tasks.iter().map(|offer| TaskId::new(&offer.task, &offer.variant));
    let tasks: Vec<TaskId> = tasks.filter(|task| task.variant == VARIANT_DEFAULT).collect();
    ensure!(!tasks.is_empty(), "server {server}: expected a task in its default variant, got none");
    Ok(tasks)
}

/// Opens the session with this index. Sessions cycle through the tasks.
pub(super) async fn open(
    network: &Network,
    server: &str,
    tasks: &[TaskId],
    side: u32,
    index: usize,
) -> Result<Environment> {
    let task = &tasks[index % tasks.len()];
    let open = Open {
        protocol: PROTOCOL_VERSION,
        task: task.task.clone(),
        variant: task.variant.clone(),
        image_height: side,
        image_width: side,
        expert: false,
        holder: "bench".to_owned(),
    };
    Environment::open(network, server, open).await.context("cannot open a session")
}

/// Resets every session.
pub(super) async fn reset(
    environments: Vec<Environment>,
    tasks: &[TaskId],
) -> Result<Vec<Episode>> {
    let begin = |(index, environment): (usize, Environment)| {
        let task = &tasks[index % tasks.len()];
        let reset = Reset {
            task: task.task.clone(),
            variant: task.variant.clone(),
            layout: None,
            seed: SeedRange::Tuning.first() + index as u64,
        };
        environment.reset(reset)
    };
    let (_, episodes) = at_once(environments.into_iter().enumerate().collect(), begin).await?;
    Ok(episodes)
}

/// Sends a request to all sessions at once. Returns the milliseconds per session, and the replies in order.
pub(super) async fn at_once<From, To, Answer>(
    sessions: Vec<From>,
    ask: impl Fn(From) -> Answer,
) -> Result<(f64, Vec<To>)>
where
    To: Send + 'static,
    Answer: Future<Output = Result<To, EnvironmentFault>> + Send + 'static,
{
    let count = sessions.len();
    let begun = Instant::now();
    if count == 1 {
        // A single session needs no spawned task. Starting and joining one would count as wire time.
        let mut answers = Vec::new();
        for session in sessions {
            answers.push(ask(session).await?);
        }
        return Ok((begun.elapsed().as_secs_f64() * 1e3, answers));
    }
    let mut asked = JoinSet::new();
    for (index, session) in sessions.into_iter().enumerate() {
        let answer = ask(session);
        asked.spawn(async move { (index, answer.await) });
    }
    let mut answers = Vec::with_capacity(count);
    while let Some(joined) = asked.join_next().await {
        let (index, answer) = joined.context("a request panicked")?;
        answers.push((index, answer?));
    }
    let ms = begun.elapsed().as_secs_f64() * 1e3 / count as f64;
    answers.sort_by_key(|(index, _)| *index);
    Ok((ms, answers.into_iter().map(|(_, answer)| answer).collect()))
}
