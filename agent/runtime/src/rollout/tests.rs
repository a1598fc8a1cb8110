//! Rollouts with scripted policies, scorers and environments, for situations that real ones do not
//! produce on request.

use std::collections::BTreeSet;
use std::sync::Mutex;

use decision::scripted::{Answer, ScriptedPolicy, ScriptedScorer};
use decision::{Setting, Strategy, TaskId};
use store::plan::EpisodePlan;
use store::queue::{ATTEMPTS_MAX, RunQueue};
use store::record::EpisodeRecord;

use super::*;
use crate::scripted::{STEPS_MAX, Script, ScriptedPool};
use crate::sinks::EventSink;

/// Collects all events.
#[derive(Clone, Default)]
struct Kept(Arc<Mutex<Vec<Event>>>);

impl EventSink for Kept {
    fn on(&mut self, event: &Event) -> Result<()> {
        self.0.lock().expect("no test panics while it holds the lock").push(event.clone());
        Ok(())
    }
}

impl Kept {
    fn records(&self) -> Vec<EpisodeRecord> {
        let events = self.0.lock().expect("unpoisoned");
        let record = |event: &Event| match event {
            Event::Recorded(record) => Some((**record).clone()),
            _ => None,
        };
        events.iter().filter_map(record).collect()
    }

    fn faults(&self) -> Vec<String> {
        let events = self.0.lock().expect("unpoisoned");
        let reason = |event: &Event| match event {
            Event::Faulted(fault) => Some(fault.reason.clone()),
            _ => None,
        };
        events.iter().filter_map(reason).collect()
    }
}

impl Kept {
    fn notices(&self) -> Vec<String> {
        let events = self.0.lock().expect("unpoisoned");
        let line = |event: &Event| match event {
            Event::Notice(line) => Some(line.clone()),
            _ => None,
        };
        events.iter().filter_map(line).collect()
    }
}

/// A rollout and everything that a test inspects or changes.
struct Stage {
    rollout: Rollout<ScriptedPool>,
    queue: Arc<RunQueue>,
    kept: Kept,
    stop: watch::Sender<Stop>,
    scorer: watch::Sender<Option<Arc<dyn Scorer>>>,
}

fn stage(policy: ScriptedPolicy, pool: &ScriptedPool, tasks: &[&str], strategy: Strategy) -> Stage {
    let plan = |(episode, task): (usize, &&str)| EpisodePlan {
        task: TaskId::default_of(*task),
        layout: None,
        episode: episode as u32,
        seed: 2_000_000_000 + episode as u64,
        sampling_seed: episode as u64,
    };
    let plans: Vec<EpisodePlan> = tasks.iter().enumerate().map(plan).collect();
    let setting = Setting { strategy, candidates: 2, temperature: 1.0 };
    let queue = Arc::new(RunQueue::new("run", &plans, &[setting], &BTreeSet::new()));
    let kept = Kept::default();
    let (stop, stopped) = watch::channel(Stop::No);
    let (scorer, newest) = watch::channel(None);
    let rollout = Rollout {
        decider: Arc::new(Decider::new(Arc::new(policy))),
        scorer: newest,
        pool: pool.clone(),
        queue: Arc::clone(&queue) as Arc<dyn EpisodeQueue>,
        sinks: Sinks::start(vec![Box::new(kept.clone())]).expect("a thread"),
        sessions: 2,
        options: RecordOptions::default(),
        needs_well_formed: true,
        versions: crate::tests::versions(),
        stop: stopped,
    };
    Stage { rollout, queue, kept, stop, scorer }
}

async fn run(tasks: &[&str], pool: ScriptedPool, policy: ScriptedPolicy) -> (Kept, Arc<RunQueue>) {
    let Stage { rollout, queue, kept, .. } = stage(policy, &pool, tasks, Strategy::Medoid);
    rollout.run().await.expect("the rollout ends");
    (kept, queue)
}

#[tokio::test]
async fn every_episode_is_recorded_once_with_all_its_steps() {
    let pool = ScriptedPool::new(&[]);
    let (kept, queue) = run(&["a", "b", "c"], pool, ScriptedPolicy::new()).await;
    let records = kept.records();
    let tasks: BTreeSet<&str> = records.iter().map(|one| &*one.identity.task).collect();
    assert_eq!((records.len(), tasks.len()), (3, 3));
    assert!(records.iter().all(|record| record.steps.len() == STEPS_MAX as usize));
    assert!(records.iter().all(|record| record.statistics.is_success));
    assert_eq!(queue.progress().await.expect("progress").completed, 3);
}

#[tokio::test]
async fn an_episode_with_a_fault_is_run_again_and_the_fault_has_no_record() {
    let pool = ScriptedPool::new(&[
        ("reset", &[Script::BreaksInReset, Script::Succeeds]),
        ("step", &[Script::BreaksInStep, Script::Succeeds]),
    ]);
    let (kept, _) = run(&["reset", "step"], pool, ScriptedPolicy::new()).await;
    assert_eq!(kept.records().len(), 2);
    let mut faults = kept.faults();
    faults.sort();
    assert_eq!(
        faults,
        [
            "physics diverged: a cube left the table at the speed of light",
            "server scripted was lost: its process ended"
        ]
    );
}

#[tokio::test]
async fn an_episode_that_always_fails_is_given_up_and_affects_no_other() {
    let pool = ScriptedPool::new(&[("bad", &[Script::BreaksInStep])]);
    let (kept, queue) = run(&["bad", "good"], pool, ScriptedPolicy::new()).await;
    assert_eq!(kept.records().len(), 1);
    assert_eq!(kept.faults().len(), ATTEMPTS_MAX as usize);
    let given_up = queue.given_up().await.expect("a list");
    assert_eq!(given_up.len(), 1);
    assert_eq!(given_up[0].identity.task, "bad");
}

#[tokio::test]
async fn an_episode_that_does_not_end_at_its_horizon_is_a_fault_of_its_server() {
    let pool = ScriptedPool::new(&[("endless", &[Script::NeverEnds, Script::Succeeds])]);
    let (kept, queue) = run(&["endless"], pool, ScriptedPolicy::new()).await;
    let faults = kept.faults();
    assert_eq!(faults.len(), 1);
    assert!(faults[0].contains("expected task endless to end after 3 steps"), "{faults:?}");
    assert_eq!(kept.records().len(), 1);
    assert_eq!(queue.progress().await.expect("progress").given_up, 0);
}

#[tokio::test]
async fn a_held_step_is_recorded_and_an_episode_that_never_acted_has_no_outcome() {
    let motions = |motions: &[Option<f32>]| Answer::Motions(motions.to_vec());
    let policy = ScriptedPolicy::new()
        .with("mute", [motions(&[None])])
        .with("once", [motions(&[None]), motions(&[Some(0.1)])]);
    let (kept, queue) = run(&["mute", "once"], ScriptedPool::new(&[]), policy).await;
    let mut records = kept.records();
    records.sort_by(|a, b| a.identity.task.cmp(&b.identity.task));
    let [mute, once] = &records[..] else { panic!("two records: {records:?}") };
    assert!(!mute.has_outcome() && once.has_outcome());
    let chosen: Vec<_> = once.decisions().map(|decision| decision.chosen).collect();
    assert_eq!(chosen, [None, Some(0), Some(0)]);
    assert_eq!(once.steps[0].action, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], "it held still");
    assert!(kept.faults().is_empty());
    assert!(
        kept.notices()
            .iter()
            .any(|line| line.contains("none of 3 decisions had a well-formed candidate"))
    );
    assert_eq!(queue.progress().await.expect("progress").completed, 2);
}

#[tokio::test]
async fn a_policy_or_a_scorer_that_fails_is_a_fault_of_its_episode_alone() {
    let policy = ScriptedPolicy::new().with("bad", [Answer::Fails("out of memory".to_owned())]);
    let pool = ScriptedPool::new(&[]);
    let Stage { rollout, kept, scorer, .. } =
        stage(policy, &pool, &["bad", "judged", "good"], Strategy::Verifier);
    let judge = ScriptedScorer::new("judge", 1.0).failing_for("judged");
    scorer.send_replace(Some(Arc::new(judge)));
    rollout.run().await.expect("the run continues");
    let records = kept.records();
    assert_eq!(records.len(), 1);
    assert_eq!(records[0].identity.task, "good");
    assert_eq!(records[0].versions.verifier.as_deref(), Some("judge"));
    let faults: BTreeSet<String> = kept.faults().into_iter().collect();
    let expected = ["policy: out of memory", "scorer: the scripted scorer fails"];
    assert_eq!(faults, expected.map(str::to_owned).into());
    let released = pool.events().iter().filter(|event| *event == "released").count();
    assert_eq!(released, 1 + 2 * ATTEMPTS_MAX as usize, "sessions are still usable");
}

#[tokio::test]
async fn an_episode_keeps_its_verifier_and_the_next_one_takes_the_newer() {
    let pool = ScriptedPool::new(&[("first", &[Script::Waits])]);
    let policy = ScriptedPolicy::new();
    let Stage { mut rollout, kept, scorer, .. } =
        stage(policy, &pool, &["first", "second"], Strategy::Verifier);
    rollout.sessions = 1;
    scorer.send_replace(Some(Arc::new(ScriptedScorer::new("old", 1.0))));
    let running = tokio::spawn(rollout.run());
    pool.seen("stepped", 1).await;
    scorer.send_replace(Some(Arc::new(ScriptedScorer::new("new", 1.0))));
    pool.go_on();
    running.await.expect("no panic").expect("the rollout ends");
    let used: Vec<_> = kept.records().into_iter().map(|one| one.versions.verifier).collect();
    assert_eq!(used, [Some("old".to_owned()), Some("new".to_owned())]);
}

#[tokio::test]
async fn stopping_once_finishes_running_episodes_and_stopping_now_discards_them() {
    for (how, recorded) in [(Stop::Finish, 2), (Stop::Now, 0)] {
        let pool = ScriptedPool::new(&[("a", &[Script::Waits]), ("b", &[Script::Waits])]);
        let policy = ScriptedPolicy::new();
        let Stage { rollout, kept, stop, queue, .. } =
            stage(policy, &pool, &["a", "b", "never", "never"], Strategy::Medoid);
        let running = tokio::spawn(rollout.run());
        pool.seen("stepped", 2).await;
        stop.send_replace(how);
        if how == Stop::Finish {
            pool.go_on();
        }
        running.await.expect("no panic").expect("a stop is no error");
        assert_eq!(kept.records().len(), recorded, "{how:?}");
        assert!(!pool.events().iter().any(|event| event.contains("never")), "{how:?}");
        assert_eq!(queue.progress().await.expect("progress").waiting, 2, "{how:?}");
    }
}

#[tokio::test]
async fn a_slow_episode_does_not_delay_others() {
    let pool = ScriptedPool::new(&[("slow", &[Script::Waits])]);
    let policy = ScriptedPolicy::new();
    let Stage { rollout, kept, .. } =
        stage(policy, &pool, &["slow", "fast", "fast", "fast"], Strategy::Medoid);
    let running = tokio::spawn(rollout.run());
    pool.seen("released", 3).await;
    assert_eq!(kept.records().len(), 3, "the others are recorded while it waits");
    pool.go_on();
    running.await.expect("no panic").expect("the rollout ends");
    assert_eq!(kept.records().len(), 4);
}

#[tokio::test]
async fn a_sink_that_fails_ends_the_run_with_its_reason() {
    struct Full;
    impl EventSink for Full {
        fn on(&mut self, event: &Event) -> Result<()> {
            match event {
                Event::Recorded(_) => anyhow::bail!("cannot write runs/x: no space left"),
                _ => Ok(()),
            }
        }
    }
    let pool = ScriptedPool::new(&[]);
    let Stage { mut rollout, queue, .. } =
        stage(ScriptedPolicy::new(), &pool, &["a"], Strategy::Medoid);
    rollout.sinks = Sinks::start(vec![Box::new(Full)]).expect("a thread");
    let error = rollout.run().await.expect_err("a record that is lost is no success");
    assert!(format!("{error:#}").contains("no space left"), "{error:#}");
    assert_eq!(queue.progress().await.expect("progress").completed, 0);
}

#[tokio::test]
async fn a_run_without_any_session_ends_with_the_pools_reason() {
    let pool = ScriptedPool::empty();
    let Stage { rollout, .. } = stage(ScriptedPolicy::new(), &pool, &["a"], Strategy::Medoid);
    let error = rollout.run().await.expect_err("nothing can be run");
    assert!(error.to_string().contains("no session of task a"), "{error:#}");
}
