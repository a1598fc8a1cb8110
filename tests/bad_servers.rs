//! Servers that violate the protocol affect only their own episodes and are reported as faulty.

use std::collections::BTreeSet;
use std::process::Output;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::Result;
use decision::scripted::ScriptedPolicy;
use decision::{Decider, Setting, Strategy, TaskId};
use protocol::{Open, PROTOCOL_VERSION};
use runtime::experiment::pool_options;
use runtime::fault::EnvironmentFault;
use runtime::rollout::{RecordOptions, Rollout};
use runtime::sinks::{Event, EventSink, Sinks};
use runtime::stop::Stop;
use runtime::wire::{Environment, Network, NetworkOptions, PoolOptions, Timing, ZenohPool};
use store::plan::EpisodePlan;
use store::queue::RunQueue;
use store::record::Versions;
use tokio::sync::watch;

use crate::harness::{rever, run, text};
use crate::server::{Server, free_endpoint, open_router};

const EPISODES: u32 = 6;
/// Maximum wait for a run that takes seconds on an idle machine.
const WAIT: Duration = Duration::from_secs(120);
/// A run without a session gives up after this time, unless the test sets another one.
const FIRST_SESSION_WAIT: Duration = Duration::from_secs(60);

/// Collects the servers of recorded episodes and the reasons of faults.
#[derive(Clone, Default)]
struct Kept(Arc<Mutex<(Vec<String>, Vec<String>)>>);

impl EventSink for Kept {
    fn on(&mut self, event: &Event) -> Result<()> {
        let mut kept = self.0.lock().expect("unpoisoned");
        match event {
            Event::Recorded(record) => kept.0.push(record.identity.id()),
            Event::Faulted(fault) => kept.1.push(fault.reason.clone()),
            Event::Started { .. } | Event::Stepped { .. } | Event::Notice(_) => {}
        }
        Ok(())
    }
}

/// Runs episodes on a correct server and on one with a defect; returns the reasons of the faults
/// and the duration.
async fn run_beside(fleet: &str, defect: &str, timing: Timing) -> (Vec<String>, Duration) {
    let endpoint = free_endpoint();
    let router = open_router(&endpoint).await;
    let _broken = Server::start_broken_behind_router(&endpoint, fleet, defect);
    let _healthy = Server::start_behind_router(&endpoint, fleet, &[]);
    let network = connected(endpoint, fleet, timing).await;
    let mut both = network.fleet();
    let both = both.wait_for(|fleet| fleet.servers.len() + fleet.undescribed.len() == 2);
    tokio::time::timeout(WAIT, both).await.expect("both are seen").expect("the network is open");
    let kept = Kept::default();
    let rollout = rollout(&network, FIRST_SESSION_WAIT, &kept);
    let begun = Instant::now();
    tokio::time::timeout(WAIT, rollout.run()).await.expect("in time").expect("the run continues");
    let took = begun.elapsed();
    network.close().await.expect("the network closes");
    router.close().await.expect("the router closes");
    let kept = kept.0.lock().expect("unpoisoned");
    assert_eq!(kept.0.len(), EPISODES as usize, "every episode is recorded: {:?}", kept.1);
    (kept.1.clone(), took)
}

/// Episodes of a scripted policy, three at a time.
fn rollout(network: &Network, wait: Duration, kept: &Kept) -> Rollout<ZenohPool> {
    let plan = |episode| EpisodePlan {
        task: TaskId::default_of("widowx_spoon_on_towel"),
        layout: None,
        episode,
        seed: 2_000_000_000 + u64::from(episode),
        sampling_seed: 1,
    };
    let plans: Vec<EpisodePlan> = (0..EPISODES).map(plan).collect();
    let setting = Setting { strategy: Strategy::Sample, candidates: 1, temperature: 1.0 };
    let queue = RunQueue::new("run", &plans, &[setting], &BTreeSet::new());
    let decider = Arc::new(Decider::new(Arc::new(ScriptedPolicy::new())));
    let pool = pool_options(decider.policy().info(), "test".to_owned(), None);
    let pool = PoolOptions { wait, first_wait: wait, ..pool };
    // Their senders were dropped, so these values never change.
    let (_, stop) = watch::channel(Stop::No);
    let (_, scorer) = watch::channel(None);
    Rollout {
        decider,
        scorer,
        pool: ZenohPool::new(network.clone(), None, pool),
        queue: Arc::new(queue),
        sinks: Sinks::start(vec![Box::new(kept.clone())]).expect("a thread"),
        sessions: 3,
        options: RecordOptions::default(),
        needs_well_formed: true,
        versions: versions(),
        stop,
    }
}

async fn connected(endpoint: String, fleet: &str, timing: Timing) -> Network {
    let options = NetworkOptions {
        connect: vec![endpoint],
        listen_here: false,
        fleet: fleet.to_owned(),
        timing,
        ..NetworkOptions::default()
    };
    Network::open(options).await.expect("the network opens")
}

fn open() -> Open {
    Open {
        protocol: PROTOCOL_VERSION,
        task: "widowx_spoon_on_towel".to_owned(),
        variant: "default".to_owned(),
        image_height: 0,
        image_width: 0,
        expert: false,
        holder: "test".to_owned(),
    }
}

fn versions() -> Versions {
    Versions {
        rever: "0.0.0".to_owned(),
        commit: String::new(),
        protocol: PROTOCOL_VERSION,
        simulator: String::new(),
        policy: String::new(),
        verifier: None,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_never_replies_to_open_delays_no_other_episodes() {
    let timing = Timing { open_max: WAIT, ..Timing::default() };
    let (faults, took) = run_beside("never-opens", "never_opens", timing).await;
    assert!(took < WAIT / 2, "the healthy server's episodes took {took:?}");
    assert!(faults.is_empty(), "no episode had begun there: {faults:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_ends_with_a_reason_if_all_sessions_stay_in_use() {
    let endpoint = free_endpoint();
    let router = open_router(&endpoint).await;
    let server = Server::start_behind_router(&endpoint, "full", &["--sessions=1"]);
    let network = connected(endpoint, "full", Timing::default()).await;
    assert_eq!(network.servers(1, WAIT).await.servers.len(), 1, "the server is found");
    let held = Environment::open(&network, &server.id, open()).await.expect("the only session");
    let kept = Kept::default();
    let rollout = rollout(&network, Duration::from_secs(4), &kept);
    let ended = tokio::time::timeout(WAIT / 2, rollout.run()).await.expect("in time");
    let error = ended.expect_err("there is no session").to_string();
    assert!(error.contains("could be opened within 4 s"), "{error}");
    assert!(error.contains("all 1 sessions are in use, by test"), "{error}");
    drop(held);
    network.close().await.expect("the network closes");
    router.close().await.expect("the router closes");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_does_not_reply_to_a_step_affects_only_its_own_episodes() {
    let timing = Timing { reply_max: Duration::from_secs(4), ..Timing::default() };
    let (faults, _) = run_beside("never-steps", "never_steps", timing).await;
    assert!(!faults.is_empty());
    let is_named = |fault: &String| fault.contains("is alive but did not reply to Step for 4 s");
    assert!(faults.iter().all(is_named), "{faults:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_whose_episodes_exceed_their_horizon_is_at_fault() {
    let (faults, _) = run_beside("never-ends", "never_ends", Timing::default()).await;
    assert!(!faults.is_empty());
    let is_named = |fault: &String| fault.contains("to end after 60 steps");
    assert!(faults.iter().all(is_named), "{faults:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_with_an_invalid_description_is_ignored() {
    let (faults, _) = run_beside("unreadable", "describes_nonsense", Timing::default()).await;
    assert!(faults.is_empty(), "{faults:?}");
}

#[test]
fn a_server_with_invalid_messages_is_reported() {
    let endpoint = free_endpoint();
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let router = runtime.block_on(open_router(&endpoint));
    let server = Server::start_broken_behind_router(&endpoint, "nonsense", "describes_nonsense");
    let folder = tempfile::tempdir().expect("a folder");
    let mut evaluate = rever();
    evaluate.current_dir(folder.path()).args(["evaluate", "--strategies=sample"]);
    let output = run(evaluate.args(["--fleet=nonsense", &format!("--connect={endpoint}")]));
    let said = text(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("no environment server found"), "{said}");
    assert!(said.contains(&format!("server {}", server.id)), "{said}");
    assert!(said.contains("invalid description"), "{said}");
    runtime.block_on(async { router.close().await }).expect("the router closes");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reply_that_precedes_its_request_is_refused() {
    let endpoint = free_endpoint();
    let router = open_router(&endpoint).await;
    let server = Server::start_broken_behind_router(&endpoint, "ahead", "answers_ahead");
    let network = connected(endpoint, "ahead", Timing::default()).await;
    assert_eq!(network.servers(1, WAIT).await.servers.len(), 1);
    let open = open();
    let reset = protocol::Reset {
        task: open.task.clone(),
        variant: open.variant.clone(),
        layout: None,
        seed: 2_000_000_000,
    };
    let environment = Environment::open(&network, &server.id, open).await.expect("a session");
    let mut episode = environment.reset(reset).await.expect("an episode");
    let fault = loop {
        match episode.step(&[0.0; 7]).await {
            Ok(transition) => assert!(!transition.terminated, "a forged reply was taken"),
            Err(fault) => break fault,
        }
    };
    let EnvironmentFault::Wire { reason } = &fault else { panic!("expected a fault, got {fault}") };
    assert!(reason.contains("before it was sent"), "{reason}");
    router.close().await.expect("the router closes");
}

#[test]
fn a_repeated_defect_of_heartbeats_is_reported_a_few_times() {
    let (output, server) = evaluate_on("beats", "beats_wildly", &["--tasks=widowx_stack_cube"]);
    let said = text(&output);
    assert!(output.status.success(), "{said}");
    let unreadable = format!("server {server}: heartbeat cannot be read");
    assert_eq!(said.matches(&unreadable).count(), 1, "{said}");
    // Once per doubling.
    let growing = said.matches(&format!("server {server} uses")).count();
    assert!((1..8).contains(&growing), "{said}");
    assert!(!said.contains("ERROR"), "{said}");
}

#[test]
fn a_task_that_no_server_offers_is_refused_and_leaves_no_run() {
    let (output, _) = evaluate_on("unknown", "any_version", &["--tasks=nonsense"]);
    let said = text(&output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("--tasks: expected one of "), "{said}");
    assert!(said.contains("got nonsense"), "{said}");
    assert!(!said.contains("rerun"), "{said}");
}

/// Evaluates one episode on a server with a defect; returns the program's output and the server's
/// id.
fn evaluate_on(fleet: &str, defect: &str, arguments: &[&str]) -> (Output, String) {
    let endpoint = free_endpoint();
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let router = runtime.block_on(open_router(&endpoint));
    let server = Server::start_broken_behind_router(&endpoint, fleet, defect);
    let folder = tempfile::tempdir().expect("a folder");
    let mut evaluate = rever();
    evaluate.current_dir(folder.path()).arg("evaluate").args(arguments).args([
        "--strategies=sample",
        "--layouts=random",
        "--episodes=1",
        "--out=run",
        "--labels=labels.sqlite",
        &format!("--fleet={fleet}"),
        &format!("--connect={endpoint}"),
    ]);
    let output = run(&mut evaluate);
    let has_run = folder.path().join("run").exists();
    assert_eq!(has_run, output.status.success(), "{}", text(&output));
    runtime.block_on(async { router.close().await }).expect("the router closes");
    (output, server.id.clone())
}
