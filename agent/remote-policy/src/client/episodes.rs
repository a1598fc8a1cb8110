//! The connections of the running episodes. Every episode has its own, so that sessions, chunks and
//! memories of different episodes never mix on a server.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, Result, anyhow, ensure};
use decision::{EpisodeName, EpisodeToken, EpisodeWatch};
use futures_util::future::try_join_all;
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::connection::{self, Connection, Greeting, Question, Reply, Target};
use crate::Wire;

/// Maximum wait at the start of an episode for a server that restarts.
const RECONNECT_WAIT: Duration = Duration::from_secs(60);
/// Time between two attempts.
const RECONNECT_INTERVAL: Duration = Duration::from_secs(1);
/// Maximum number of connections per episode to a server without a state.
const PARALLEL_MAX: usize = 8;
/// Maximum number of connections per episode to a vla-eval server, one per candidate.
const SESSIONS_MAX: usize = 64;

/// The running episodes by their tokens.
#[derive(Default)]
pub struct Episodes {
    running: Mutex<HashMap<usize, Running>>,
}

struct Running {
    watch: EpisodeWatch,
    session: Arc<tokio::sync::Mutex<Session>>,
}

/// The connections of one episode.
pub struct Session {
    name: EpisodeName,
    connections: Vec<Connection>,
    /// The last seed, question and answers. A decision that is retried because another episode's
    /// failed must not reach the server twice.
    last: Option<(u64, Question, Vec<Reply>)>,
    /// Why the episode cannot go on: the server has lost its state.
    failed: Option<String>,
}

impl Episodes {
    /// The session of an episode; a new one for a decision by itself.
    pub fn session(&self, token: Option<&EpisodeToken>) -> Arc<tokio::sync::Mutex<Session>> {
        let Some(token) = token else {
            return Arc::new(Session::new(EpisodeName::default()).into());
        };
        let mut running = self.running.lock().unwrap_or_else(PoisonError::into_inner);
        let new = || Running {
            watch: token.watch(),
            session: Arc::new(Session::new(token.name().clone()).into()),
        };
        Arc::clone(&running.entry(token.key()).or_insert_with(new).session)
    }

    /// Ends the sessions of the episodes that are over.
    pub async fn end_finished(&self) {
        let finished: Vec<Running> = {
            let mut running = self.running.lock().unwrap_or_else(PoisonError::into_inner);
            running.extract_if(|_, running| running.watch.is_over()).map(|(_, one)| one).collect()
        };
        for one in finished {
            one.session.lock().await.end().await;
        }
    }
}

impl Session {
    fn new(name: EpisodeName) -> Session {
        Session { name, connections: Vec::new(), last: None, failed: None }
    }

    /// Asks one question `count` times. After an error the episode cannot go on.
    pub async fn ask(
        &mut self,
        target: &Target,
        greeting: &Greeting,
        question: &Question,
        (seed, count): (u64, usize),
    ) -> Result<Vec<Reply>> {
        if let Some(reason) = &self.failed {
            return Err(anyhow!("{reason}"));
        }
        if let Some((last_seed, last, replies)) = &self.last
            && *last_seed == seed
            && last == question
            && replies.len() == count
        {
            return Ok(replies.clone());
        }
        match self.try_ask(target, greeting, question, count).await {
            Ok(replies) => {
                self.last = Some((seed, question.clone(), replies.clone()));
                Ok(replies)
            }
            Err(error) => {
                self.connections.clear();
                let reason = format!("{}: {error:#}", target.address);
                self.failed = Some(reason.clone());
                Err(anyhow!("{reason}"))
            }
        }
    }

    async fn try_ask(
        &mut self,
        target: &Target,
        greeting: &Greeting,
        question: &Question,
        count: usize,
    ) -> Result<Vec<Reply>> {
        let observation = &connection::observation(target, question)?;
        let wanted = connections_wanted(target.address.wire, count)?;
        // Every session of a vla-eval server must see every observation of the episode.
        let before = self.last.as_ref().map(|(_, _, replies)| replies.len());
        ensure!(
            target.address.wire != Wire::VlaEval || before.is_none_or(|before| before == count),
            "expected as many candidates in every decision of an episode"
        );
        while self.connections.len() < wanted {
            let mut connection = reconnect(target, greeting).await?;
            connection.begin(&self.name).await?;
            self.connections.push(connection);
        }
        let shares = self.connections.iter_mut().take(wanted).enumerate().map(
            |(index, connection)| async move {
                let share = (index..count).step_by(wanted).count();
                let mut replies = Vec::with_capacity(share);
                for _ in 0..share {
                    replies.push(connection.ask(target, observation).await?);
                }
                anyhow::Ok(replies)
            },
        );
        Ok(try_join_all(shares).await?.into_iter().flatten().collect())
    }

    async fn end(&mut self) {
        for connection in self.connections.drain(..) {
            connection.end().await;
        }
    }
}

/// A vla-eval server keeps state per connection, so every candidate has its own connection, which
/// sees every observation once. Other servers share at most [`PARALLEL_MAX`] connections.
pub fn connections_wanted(wire: Wire, count: usize) -> Result<usize> {
    match wire {
        Wire::VlaEval => {
            ensure!(
                count <= SESSIONS_MAX,
                "expected at most {SESSIONS_MAX} candidates of a vla-eval server, which keeps a session for each, \
                 got {count}"
            );
            Ok(count)
        }
        Wire::OpenPi | Wire::Act => Ok(count.min(PARALLEL_MAX)),
    }
}

/// Connects, and waits for a server that is started again.
async fn reconnect(target: &Target, expected: &Greeting) -> Result<Connection> {
    let deadline = Instant::now() + RECONNECT_WAIT;
    let mut ticks = interval(RECONNECT_INTERVAL);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let error = match Connection::open(target).await {
            Ok((connection, greeting)) => {
                let is_same = greeting == *expected;
                ensure!(
                    is_same,
                    "another policy is served now: its metadata has changed during the run"
                );
                return Ok(connection);
            }
            Err(error) => error,
        };
        let is_absent = error.chain().any(|cause| cause.is::<std::io::Error>());
        if !is_absent || Instant::now() > deadline {
            let secs = RECONNECT_WAIT.as_secs();
            let waited = if is_absent {
                format!("no policy server for {secs} s")
            } else {
                "no session".to_owned()
            };
            return Err(error).context(waited);
        }
    }
}
