//! Scripted environments for the tests of rollouts.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Result, bail};
use bytes::Bytes;
use protocol::{
    Dimension, FaultKind, Image, Observation, Reset, Statistics, TaskDescription, Transition,
};
use tokio::sync::watch;

use crate::fault::EnvironmentFault;
use crate::session::{Environment, Episode, Session, SessionInfo, SessionPool, SessionRequest};

/// Number of control steps of every scripted episode.
pub const STEPS_MAX: u32 = 3;

/// What happens in one attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Script {
    /// The episode ends and succeeds.
    Succeeds,
    /// The reset fails: the server is lost.
    BreaksInReset,
    /// The second step fails: the physics diverge.
    BreaksInStep,
    /// The episode never ends.
    NeverEnds,
    /// The first step waits for [`ScriptedPool::go_on`].
    Waits,
}

/// A pool whose environments follow the scripts of the tasks.
#[derive(Clone)]
pub struct ScriptedPool {
    shared: Arc<Shared>,
}

struct Shared {
    scripts: Mutex<BTreeMap<String, VecDeque<Script>>>,
    events: Mutex<Vec<String>>,
    may_go_on: watch::Sender<bool>,
    is_empty: bool,
}

/// An environment of the pool.
pub struct ScriptedEnvironment {
    shared: Arc<Shared>,
}

/// An episode of it.
pub struct ScriptedEpisode {
    environment: ScriptedEnvironment,
    script: Script,
    observation: Observation,
    steps: u32,
    actions: Vec<Vec<f32>>,
}

impl ScriptedPool {
    /// A pool that offers every task. Each attempt uses the next script of its task; the last one
    /// repeats.
    pub fn new(scripts: &[(&str, &[Script])]) -> ScriptedPool {
        ScriptedPool::made(scripts, false)
    }

    /// A pool without sessions.
    pub fn empty() -> ScriptedPool {
        ScriptedPool::made(&[], true)
    }

    fn made(scripts: &[(&str, &[Script])], is_empty: bool) -> ScriptedPool {
        let scripts = scripts
            .iter()
            .map(|(task, scripts)| ((*task).to_owned(), scripts.iter().copied().collect()))
            .collect();
        let shared = Shared {
            scripts: Mutex::new(scripts),
            events: Mutex::default(),
            may_go_on: watch::Sender::new(false),
            is_empty,
        };
        ScriptedPool { shared: Arc::new(shared) }
    }

    /// The events of all sessions, in order.
    pub fn events(&self) -> Vec<String> {
        self.shared.events.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Waits until an event has happened `count` times.
    pub async fn seen(&self, event: &str, count: usize) {
        let find = || self.events().iter().filter(|one| *one == event).count();
        let wait = async {
            while find() < count {
                tokio::task::yield_now().await;
            }
        };
        tokio::time::timeout(Duration::from_secs(10), wait).await.expect("it happens in time");
    }

    /// Continues all waiting episodes.
    pub fn go_on(&self) {
        self.shared.may_go_on.send_replace(true);
    }
}

impl Shared {
    fn note(&self, event: impl Into<String>) {
        self.events.lock().unwrap_or_else(PoisonError::into_inner).push(event.into());
    }

    fn next(&self, task: &str) -> Script {
        let mut scripts = self.scripts.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(script) = scripts.get_mut(task) else { return Script::Succeeds };
        match script.len() {
            0 => Script::Succeeds,
            1 => script[0],
            _ => script.pop_front().unwrap_or(Script::Succeeds),
        }
    }
}

impl SessionPool for ScriptedPool {
    type Environment = ScriptedEnvironment;

    async fn acquire(&self, request: &SessionRequest) -> Result<Session<ScriptedEnvironment>> {
        if self.shared.is_empty {
            bail!("no session of task {} could be opened", request.task);
        }
        self.shared.note("acquired");
        let info = SessionInfo {
            server: "scripted".to_owned(),
            simulator: "scripted 1".to_owned(),
            task: description(&request.task.task),
        };
        let environment = ScriptedEnvironment { shared: Arc::clone(&self.shared) };
        Ok(Session { info, environment })
    }

    fn release(&self, _session: Session<ScriptedEnvironment>) {
        self.shared.note("released");
    }

    fn lost(&self, _info: &SessionInfo, fault: &EnvironmentFault) {
        self.shared.note(format!("lost: {fault}"));
    }
}

impl Environment for ScriptedEnvironment {
    type Episode = ScriptedEpisode;

    async fn reset(self, reset: Reset) -> Result<ScriptedEpisode, EnvironmentFault> {
        let script = self.shared.next(&reset.task);
        self.shared.note(format!("reset {}", reset.task));
        if script == Script::BreaksInReset {
            return Err(EnvironmentFault::ServerLost { server: "scripted".to_owned() });
        }
        let observation = observation(&reset.task);
        Ok(ScriptedEpisode {
            environment: self,
            script,
            observation,
            steps: 0,
            actions: Vec::new(),
        })
    }
}

impl Episode for ScriptedEpisode {
    type Environment = ScriptedEnvironment;

    fn observation(&self) -> &Observation {
        &self.observation
    }

    async fn step(&mut self, action: &[f32]) -> Result<Transition, EnvironmentFault> {
        let shared = &self.environment.shared;
        self.steps += 1;
        self.actions.push(action.to_vec());
        shared.note("stepped");
        if self.script == Script::Waits && self.steps == 1 {
            let mut may_go_on = shared.may_go_on.subscribe();
            // The pool outlives its episodes.
            let _ = may_go_on.wait_for(|may| *may).await;
        }
        if self.script == Script::BreaksInStep && self.steps == 2 {
            let reason = "a cube left the table at the speed of light".to_owned();
            return Err(EnvironmentFault::Faulted { kind: FaultKind::PhysicsDiverged, reason });
        }
        let is_over = self.steps >= STEPS_MAX && self.script != Script::NeverEnds;
        Ok(Transition {
            observation: self.observation.clone(),
            statistics: Statistics { is_success: is_over, ..Statistics::default() },
            reward: f32::from(u8::from(is_over)),
            terminated: false,
            truncated: is_over,
        })
    }

    fn simulator_time(&self) -> Duration {
        Duration::ZERO
    }

    fn finish(self) -> ScriptedEnvironment {
        self.environment
    }
}

fn observation(instruction: &str) -> Observation {
    Observation {
        image: Image { height: 0, width: 0, pixels: Bytes::new() },
        state: vec![0.0; 8],
        instruction: instruction.to_owned(),
        expert_action: None,
    }
}

pub(crate) fn description(task: &str) -> TaskDescription {
    let names = ["x", "y", "z", "rotation_x", "rotation_y", "rotation_z", "gripper"];
    let dimension =
        |name: &str| Dimension { name: name.to_owned(), low: None, high: None, discrete: false };
    TaskDescription {
        task: task.to_owned(),
        variant: "default".to_owned(),
        version: 1,
        instruction: task.to_owned(),
        steps_max: STEPS_MAX,
        control_hz: None,
        layouts: 0,
        state: Vec::new(),
        action: names.map(dimension).to_vec(),
    }
}
