//! A run with made-up episodes, for tests of the report alone.

use std::path::Path;

use protocol::Statistics;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;

use super::{EpisodeTerms, Readers, Speech};
use decision::{ActionChunk, Reasoning, VisibleObject};
use store::queue::FaultScope;
use store::record::{
    CandidateRecord, DecisionRecord, EpisodeIdentity, EpisodeRecord, RECORD_VERSION, StepRecord,
    Versions,
};
use store::run::{EpisodeSummary, FaultRecord, Run, RunRequest, write_video};
use store::video::Video;

pub const TASKS: [&str; 2] = ["widowx_spoon_on_towel", "widowx_stack_cube"];
const SETTINGS: [(&str, u32); 3] = [("greedy", 1), ("sample", 1), ("verifier", 5)];
const EPISODES: u32 = 4;
const STEPS: usize = 60;

/// What a made-up token sequence says: the first token decides everything.
pub fn speak(tokens: &[u32]) -> Speech {
    let first = u16::try_from(tokens[0] % 200).expect("small");
    let text = format!("TASK: <b>{first}</b> & \"more\"");
    let object = |name: &str, shift: u16| VisibleObject {
        name: name.to_owned(),
        bounding_box: [first / 2 + shift, 80 + shift, first / 2 + shift + 40, 120 + shift],
    };
    let reasoning = Reasoning {
        task: "put the spoon on the towel".into(),
        plan: "reach the spoon, grasp it, lift it, move it over the towel, release it".into(),
        visible_objects: vec![object("spoon", 0), object("towel", 60)],
        subtask_reasoning: "the spoon is not grasped yet and the gripper is away from it".into(),
        subtask: if first % 3 == 0 { "grasp the spoon".into() } else { "reach the spoon".into() },
        move_reasoning: "the gripper must go to above the spoon".into(),
        movement: format!("move {}", ["forward", "left down", "<script>"][first as usize % 3]),
        gripper_position: vec![[128, first]],
        unread: Vec::new(),
    };
    Speech { text, reasoning: (first % 17 != 0).then_some(reasoning) }
}

/// Reads the made-up run; every candidate's advantage is the sum of three terms.
pub fn readers() -> Readers<'static> {
    let names = ["agreement", "confidence", "<i>target</i>"].map(str::to_owned);
    Readers { speak: &speak, terms: names.to_vec(), explain: &|record| Ok(explain(record)) }
}

fn explain(record: &EpisodeRecord) -> EpisodeTerms {
    if record.identity.candidates == 1 {
        return EpisodeTerms::Unknown("one candidate has no siblings".to_owned());
    }
    let row = |index: usize| vec![0.01 * index as f32, -0.002, 0.0];
    let terms = |decision: &DecisionRecord| {
        let count = decision.candidates.iter().filter(|one| one.actions.is_some()).count();
        (0..count).map(row).collect()
    };
    let steps = record.steps.iter().map(|step| step.decision.as_ref().map(terms));
    EpisodeTerms::Known(steps.collect())
}

/// Attempts of one episode that never ended.
pub fn faults() -> Vec<FaultRecord> {
    let identity = identity(TASKS[1], EPISODES, "verifier", 5);
    let fault = |attempt| FaultRecord {
        identity: identity.clone(),
        attempt,
        server: "server".to_owned(),
        scope: FaultScope::Server,
        reason: "the server went away".to_owned(),
    };
    vec![fault(1), fault(2)]
}

/// All records of the made-up run.
pub fn records() -> Vec<EpisodeRecord> {
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut records = Vec::new();
    for task in TASKS {
        for episode in 0..EPISODES {
            for (strategy, candidates) in SETTINGS {
                let chance = if strategy == "verifier" { 0.6 } else { 0.35 };
                let identity = identity(task, episode, strategy, candidates);
                records.push(record(identity, random.random_bool(chance), &mut random));
            }
        }
    }
    records
}

pub fn summaries() -> Vec<EpisodeSummary> {
    records().iter().map(EpisodeSummary::from).collect()
}

/// Writes the run into a folder, with a video of every verifier episode on the first task.
pub fn write(folder: &Path) -> anyhow::Result<()> {
    let options = json!({ "strategies": ["greedy", "sample", "verifier"], "temperatures": [1.0] });
    let versions = json!({ "rever": "0.0.0", "simulator": "made up" });
    let folder = folder.to_path_buf();
    let run = Run::open(&RunRequest { folder, options, versions, ..RunRequest::default() })?;
    let mut records = records();
    for record in &mut records {
        record.identity.run.clone_from(&run.header.run);
        if has_video(record) {
            write_video(&run.folder, &record.identity.id(), &video(record)?)?;
        }
        run.record(record)?;
    }
    for fault in faults() {
        run.fault(&fault)?;
    }
    run.complete()
}

/// Videos are slow to make, so only some episodes have one.
pub fn has_video(record: &EpisodeRecord) -> bool {
    record.identity.task == TASKS[0] && record.identity.strategy == "verifier"
}

fn identity(task: &str, episode: u32, strategy: &str, candidates: u32) -> EpisodeIdentity {
    EpisodeIdentity {
        run: "made-up".into(),
        task: task.into(),
        variant: "default".into(),
        layout: (episode > 2).then_some(episode),
        episode,
        seed: 3_000_000_000 + u64::from(episode),
        sampling_seed: u64::from(episode),
        strategy: strategy.into(),
        candidates,
        temperature: if strategy == "greedy" { 0.0 } else { 1.0 },
    }
}

fn record(identity: EpisodeIdentity, is_success: bool, random: &mut ChaCha8Rng) -> EpisodeRecord {
    let steps: Vec<StepRecord> = (0..STEPS)
        .map(|step| {
            let late = is_success && step > 45;
            let grasped = (is_success || identity.episode == 1) && step > 20;
            let level = if is_success { 0.3 + step as f32 * 0.009 } else { 0.35 };
            let made: Vec<CandidateRecord> =
                (0..identity.candidates).map(|_| candidate(level, random)).collect();
            StepRecord {
                state: vec![0.0; 8],
                action: vec![0.0; 7],
                decision: Some(DecisionRecord {
                    chosen: (0..)
                        .zip(&made)
                        .find(|(_, one)| one.actions.is_some())
                        .map(|(index, _)| index),
                    candidates: made,
                    batch_ms: 86.0,
                    batch_size: 4,
                }),
                statistics: statistics(late, grasped),
                step_ms: 4.25,
                simulator_ms: 3.75,
            }
        })
        .collect();
    let statistics = steps.last().map(|step| step.statistics).expect("steps");
    EpisodeRecord {
        version: RECORD_VERSION,
        instruction: "put the spoon on the towel".into(),
        steps_max: 60,
        versions: Versions {
            rever: "0.0.0".into(),
            commit: "0".repeat(40),
            protocol: 1,
            simulator: "made up".into(),
            policy: "0".repeat(64),
            verifier: Some("1".repeat(64)),
        },
        statistics,
        steps,
        wall_secs: 4.0,
        identity,
    }
}

fn candidate(level: f32, random: &mut ChaCha8Rng) -> CandidateRecord {
    let tokens: Vec<u32> = (0..3).map(|_| random.random_range(0..200)).collect();
    let is_well_formed = speak(&tokens).reasoning.is_some();
    let mut coordinate = || random.random_range(-0.02..0.02);
    let action =
        vec![coordinate(), coordinate(), coordinate(), coordinate(), 0.0, coordinate(), 1.0];
    CandidateRecord {
        actions: is_well_formed.then(|| ActionChunk::single(action).expect("finite numbers")),
        malformed: (!is_well_formed).then(|| "expected 7 action tokens, got </s>".to_owned()),
        unread: Vec::new(),
        score: is_well_formed.then(|| (level + random.random_range(-0.2..0.2)).clamp(0.0, 1.0)),
        log_probability: -12.5,
        log_probabilities: Vec::new(),
        hidden: None,
        reading: None,
        tokens,
    }
}

fn statistics(is_success: bool, is_grasped: bool) -> Statistics {
    Statistics {
        is_success,
        is_grasped,
        ever_grasped: is_grasped,
        consecutive_grasp: is_grasped,
        moved_correct_object: is_grasped,
        moved_wrong_object: false,
        source_on_target: is_success,
        ever_success: is_success,
        released_success: false,
    }
}

/// A bright square at the height that counts the frames.
fn video(record: &EpisodeRecord) -> anyhow::Result<Vec<u8>> {
    let mut video = Video::new(128, 128)?;
    for frame in 0..=record.steps.len() {
        let mut pixels = vec![70; 128 * 128 * 3];
        for row in frame..frame + 20 {
            for column in 54..74 {
                let at = (row * 128 + column) * 3;
                pixels[at..at + 3].copy_from_slice(&[230, 200, 60]);
            }
        }
        video.push(&pixels)?;
    }
    video.finish()
}
