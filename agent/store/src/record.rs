//! The record of one finished episode: everything that tables, labels, videos and reports are rebuilt from.
//!
//! A record is one MessagePack file (maps with string keys), written at once when the episode ends. There is no record of
//! an episode that broke: a fault leaves nothing behind that could become a label.

use std::fs::{File, Permissions};
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use decision::{Action, ActionChunk, Setting, Strategy, TaskId};
use half::f16;
use protocol::Statistics;
use serde::{Deserialize, Serialize};

/// Version of the format; a record of another version is refused.
pub const RECORD_VERSION: u32 = 4;

/// What is known of a finished episode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeRecord {
    /// [`RECORD_VERSION`].
    pub version: u32,
    /// Which episode this is.
    pub identity: EpisodeIdentity,
    /// What it was run with.
    pub versions: Versions,
    /// The instruction as the policy read it.
    pub instruction: String,
    /// The task's horizon: control steps after which an episode is truncated.
    pub steps_max: u32,
    /// As of the last step; success is read here.
    pub statistics: Statistics,
    /// One entry per control step, in order.
    pub steps: Vec<StepRecord>,
    /// Seconds from the reset to the last step; episodes share the machine with others.
    pub wall_secs: f32,
}

/// What tells one episode from every other. Everything that its course depends on is in here or in [`Versions`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeIdentity {
    /// The run that it belongs to.
    pub run: String,
    /// The task's name.
    pub task: String,
    /// The task's variant.
    pub variant: String,
    /// One of the 24 layouts, or none for a random one drawn from `seed`.
    pub layout: Option<u32>,
    /// Number within task and variant; equal numbers of one run are paired.
    pub episode: u32,
    /// The world's seed.
    pub seed: u64,
    /// The policy's seed, the same for every strategy.
    pub sampling_seed: u64,
    /// How candidates were chosen.
    pub strategy: String,
    /// Candidates per step.
    pub candidates: u32,
    /// Sampling temperature; 0 is greedy.
    pub temperature: f32,
}

impl EpisodeIdentity {
    /// The episode's name within its run: a file name and a part of a link, so only `a-z A-Z 0-9 . _ -` stand in it.
    pub fn id(&self) -> String {
        format!(
            "{}-{}-{:04}-{}-n{}-t{}",
            self.task,
            self.variant,
            self.episode,
            self.strategy.replace('+', "_"),
            self.candidates,
            self.temperature
        )
    }

    /// How it was run.
    pub fn setting(&self) -> Result<Setting> {
        let strategy: Strategy = self.strategy.parse()?;
        Ok(Setting { strategy, candidates: self.candidates, temperature: self.temperature })
    }

    /// What was to be done.
    pub fn task_id(&self) -> TaskId {
        TaskId::new(&self.task, &self.variant)
    }
}

/// Versions of everything that an episode depends on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Versions {
    /// Of the program.
    pub rever: String,
    /// Of the protocol.
    pub protocol: u32,
    /// The server's simulator and its version.
    pub simulator: String,
    /// Digest of the policy's weights and configuration, hexadecimal.
    pub policy: String,
    /// Digest of the verifier that scored, hexadecimal.
    pub verifier: Option<String>,
}

/// One control step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StepRecord {
    /// What the robot felt before, as the task's description says. In a Bridge task: x y z (m), roll pitch yaw (rad), 0,
    /// gripper opening.
    pub state: Vec<f32>,
    /// What was decided here; none for a step that executes a further action of the chunk decided before.
    pub decision: Option<DecisionRecord>,
    /// What was executed.
    pub action: Action,
    /// After this step.
    pub statistics: Statistics,
    /// From the action to the next observation.
    pub step_ms: f32,
    /// Of `step_ms`, the server's time for physics, image and statistics.
    pub simulator_ms: f32,
}

/// One decision.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DecisionRecord {
    /// All that were sampled.
    pub candidates: Vec<CandidateRecord>,
    /// The executed one; none when no candidate was well formed and the robot held still.
    pub chosen: Option<u32>,
    /// From the observations of the batch to its chosen actions.
    pub batch_ms: f32,
    /// Decisions that were made together, this one included.
    pub batch_size: u32,
}

/// One sampled candidate. Its text is rebuilt from the tokens with the policy's tokenizer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CandidateRecord {
    /// The completion, reasoning and action.
    pub tokens: Vec<u32>,
    /// What it would do; none for a malformed candidate.
    pub actions: Option<ActionChunk>,
    /// Why it does not parse.
    pub malformed: Option<String>,
    /// The scorer's probability of success.
    pub score: Option<f32>,
    /// Of the sampled tokens at temperature 1.
    pub log_probability: f32,
    /// Of each token, at temperature 1.
    pub log_probabilities: Vec<f32>,
    /// The last token's final hidden state, 16-bit floats, little endian; always there for the chosen candidate.
    #[serde(with = "serde_bytes")]
    pub hidden: Option<Vec<u8>>,
}

impl DecisionRecord {
    /// The decision's share of its batch's time.
    pub fn milliseconds(&self) -> f32 {
        self.batch_ms / self.batch_size.max(1) as f32
    }
}

impl EpisodeRecord {
    /// The decisions in their order.
    pub fn decisions(&self) -> impl Iterator<Item = &DecisionRecord> {
        self.steps.iter().filter_map(|step| step.decision.as_ref())
    }

    /// The mean of the chosen candidates' scores; none without a scorer or without any choice.
    pub fn score_mean(&self) -> Option<f32> {
        let chosen = self
            .decisions()
            .filter_map(|decision| decision.candidates.get(decision.chosen? as usize)?.score);
        let (sum, count) =
            chosen.fold((0.0_f32, 0_u32), |(sum, count), score| (sum + score, count + 1));
        (count > 0).then(|| sum / count as f32)
    }

    /// Writes the record so that after any interruption the file is whole or absent.
    pub fn write(&self, path: &Path) -> Result<()> {
        let bytes = rmp_serde::to_vec_named(self).context("cannot encode the record")?;
        write_whole(path, &bytes)
    }

    /// Reads a record; every byte must belong to it.
    pub fn read(path: &Path) -> Result<EpisodeRecord> {
        let name = path.display();
        let bytes =
            std::fs::read(path).with_context(|| format!("cannot read the record {name}"))?;
        // The version comes first: a record of another one may lack what this one has.
        let Versioned { version } = rmp_serde::from_slice(&bytes)
            .with_context(|| format!("{name} is not an episode record"))?;
        ensure!(
            version == RECORD_VERSION,
            "{name}: expected record version {RECORD_VERSION}, got {version}"
        );
        let mut rest = bytes.as_slice();
        let record: EpisodeRecord = rmp_serde::from_read(&mut rest)
            .with_context(|| format!("{name} is not an episode record"))?;
        ensure!(rest.is_empty(), "{name}: expected one record, got {} bytes after it", rest.len());
        Ok(record)
    }
}

/// What records of all versions have.
#[derive(Deserialize)]
struct Versioned {
    version: u32,
}

/// A hidden state as it stands in a record.
pub fn hidden_to_bytes(hidden: &[f32]) -> Vec<u8> {
    hidden.iter().flat_map(|value| f16::from_f32(*value).to_le_bytes()).collect()
}

/// A hidden state from a record.
pub fn hidden_from_bytes(bytes: &[u8]) -> Result<Vec<f32>> {
    ensure!(
        bytes.len().is_multiple_of(2),
        "hidden state: expected 16-bit numbers, got {} bytes",
        bytes.len()
    );
    Ok(bytes.chunks_exact(2).map(|pair| f16::from_le_bytes([pair[0], pair[1]]).to_f32()).collect())
}

/// Writes a file under a temporary name, makes it durable, then gives it its name.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let name = path.display();
    let folder = path.parent().with_context(|| format!("{name} has no folder"))?;
    // Others may read what is written, as far as the umask lets them: runs lie on shared volumes.
    let mut file = tempfile::Builder::new()
        .permissions(Permissions::from_mode(0o666))
        .tempfile_in(folder)
        .with_context(|| format!("cannot create {name}"))?;
    file.write_all(bytes)
        .and_then(|()| file.as_file().sync_all())
        .with_context(|| format!("cannot write {name}"))?;
    file.persist(path).with_context(|| format!("cannot write {name}"))?;
    // The name itself is durable only when its folder is.
    File::open(folder)
        .and_then(|folder| folder.sync_all())
        .with_context(|| format!("cannot write {name}"))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    fn chunk() -> ActionChunk {
        ActionChunk::single(vec![0.01, -0.02, 0.0, 0.1, 0.0, -0.1, 1.0]).expect("an action")
    }

    /// A record with one step of two candidates, the second malformed.
    pub(crate) fn made_up(episode: u32) -> EpisodeRecord {
        let candidate = CandidateRecord {
            tokens: vec![7, 400, 65_000],
            actions: Some(chunk()),
            malformed: None,
            score: Some(0.75),
            log_probability: -3.5,
            log_probabilities: vec![-1.0, -2.0, -0.5],
            hidden: Some(hidden_to_bytes(&[0.5, -2.0])),
        };
        let malformed = CandidateRecord {
            actions: None,
            malformed: Some("expected 7 action tokens, got 6".into()),
            score: None,
            hidden: None,
            ..candidate.clone()
        };
        EpisodeRecord {
            version: RECORD_VERSION,
            identity: EpisodeIdentity {
                run: "made-up".into(),
                task: "widowx_stack_cube".into(),
                variant: "default".into(),
                layout: None,
                episode,
                seed: 3_000_000_001,
                sampling_seed: 9_007_199_254_740_991,
                strategy: "verifier+medoid".into(),
                candidates: 2,
                temperature: 0.7,
            },
            versions: Versions {
                rever: "0.0.0".into(),
                protocol: 1,
                simulator: "made up 1".into(),
                policy: "cafe".into(),
                verifier: Some("beef".into()),
            },
            instruction: "stack the green cube on the yellow cube".into(),
            steps_max: 60,
            statistics: Statistics {
                is_success: episode.is_multiple_of(2),
                ..Statistics::default()
            },
            steps: vec![StepRecord {
                state: vec![0.25; 8],
                decision: Some(DecisionRecord {
                    candidates: vec![candidate, malformed],
                    chosen: Some(0),
                    batch_ms: 20.5,
                    batch_size: 2,
                }),
                action: chunk().first().to_vec(),
                statistics: Statistics::default(),
                step_ms: 4.0,
                simulator_ms: 3.5,
            }],
            wall_secs: 1.5,
        }
    }

    #[test]
    fn a_record_is_read_back_whole() {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, record) = (folder.path().join("a.msgpack"), made_up(3));
        record.write(&path).expect("written");
        assert_eq!(EpisodeRecord::read(&path).expect("read"), record);
        assert_eq!(
            std::fs::read_dir(folder.path()).expect("a folder").count(),
            1,
            "no temporary left"
        );
        assert_eq!(record.identity.id(), "widowx_stack_cube-default-0003-verifier_medoid-n2-t0.7");
        assert_eq!(record.score_mean(), Some(0.75));
        let setting = record.identity.setting().expect("a setting");
        assert_eq!(setting.to_string(), "verifier+medoid N=2 T=0.7");
    }

    #[test]
    fn damaged_and_foreign_records_are_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.msgpack");
        let check = |bytes: &[u8], expected: &str| {
            std::fs::write(&path, bytes).expect("written");
            let error = EpisodeRecord::read(&path).expect_err(expected);
            assert!(format!("{error:#}").contains(expected), "{error:#}");
        };
        let bytes = rmp_serde::to_vec_named(&made_up(0)).expect("bytes");
        check(&bytes[..bytes.len() - 1], "is not an episode record");
        check(&[&bytes[..], &[0]].concat(), "expected one record, got 1 bytes after it");
        let later = EpisodeRecord { version: 5, ..made_up(0) };
        check(&rmp_serde::to_vec_named(&later).expect("bytes"), "expected record version 4, got 5");
        // A record of the first version, which had no log-probabilities of tokens.
        let first = serde_json::json!({"version": 1, "steps": [{"log_probability": -3.5}]});
        check(&rmp_serde::to_vec_named(&first).expect("bytes"), "expected record version 4, got 1");
    }

    #[test]
    fn hidden_states_keep_sixteen_bits() {
        let hidden = [0.0, 1.0, -0.333_251_95, 65_504.0];
        assert_eq!(hidden_from_bytes(&hidden_to_bytes(&hidden)).expect("pairs"), hidden);
        assert!(hidden_from_bytes(&[0, 1, 2]).is_err());
    }
}
