//! The record of one finished episode, from which tables, labels, videos and reports are rebuilt.
//!
//! A record is one MessagePack file (maps with string keys), written when the episode ends. An
//! episode that ends in a fault has no record, so that a fault never becomes a label.

mod file;

use anyhow::{Result, ensure};
use decision::{Action, ActionChunk, Reasoning};
use half::f16;
use protocol::Statistics;
use serde::{Deserialize, Serialize};

pub use crate::identity::EpisodeIdentity;
pub use file::{ReadError, RecordFile};

/// Version of the format; a record of another version is refused.
pub const RECORD_VERSION: u32 = 4;

/// The data of a finished episode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeRecord {
    /// [`RECORD_VERSION`].
    pub version: u32,
    /// The identity of the episode.
    pub identity: EpisodeIdentity,
    /// The versions that it was run with.
    pub versions: Versions,
    /// The instruction as given to the policy.
    pub instruction: String,
    /// Horizon: an episode is truncated after so many control steps.
    pub steps_max: u32,
    /// The statistics at the last step, including the success.
    pub statistics: Statistics,
    /// One entry per control step, in order.
    pub steps: Vec<StepRecord>,
    /// Seconds from the reset to the last step; other episodes run on the machine at the same time.
    pub wall_secs: f32,
}

/// Versions of everything that affects an episode.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Versions {
    /// Version of the program.
    pub rever: String,
    /// The commit of the build, formatted by
    /// [`Build::commit_text`](crate::provenance::Build::commit_text).
    pub commit: String,
    /// Version of the protocol.
    pub protocol: u32,
    /// The server's simulator and its version.
    pub simulator: String,
    /// Digest of the policy's weights and configuration, in hexadecimal.
    pub policy: String,
    /// Digest of the verifier that scored the candidates, in hexadecimal.
    pub verifier: Option<String>,
}

/// One control step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StepRecord {
    /// The robot's state before the step, with the dimensions in the task's description. For a
    /// Bridge task: x, y, z (m), roll, pitch, yaw (rad), 0, gripper opening.
    pub state: Vec<f32>,
    /// The decision at this step; `None` if the step executes a further action of an earlier chunk.
    pub decision: Option<DecisionRecord>,
    /// The executed action.
    pub action: Action,
    /// The statistics after this step.
    pub statistics: Statistics,
    /// Time from the action to the next observation.
    pub step_ms: f32,
    /// The part of `step_ms` that the server spent on physics, image and statistics.
    pub simulator_ms: f32,
}

/// One decision.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DecisionRecord {
    /// All sampled candidates.
    pub candidates: Vec<CandidateRecord>,
    /// Index of the executed candidate; `None` if no candidate was well formed and the robot held
    /// still.
    pub chosen: Option<u32>,
    /// Time from the observations of the batch to its chosen actions.
    pub batch_ms: f32,
    /// Number of decisions in the batch, including this one.
    pub batch_size: u32,
}

/// One sampled candidate. Its text is decoded from the tokens with the policy's tokenizer, or kept
/// in `reading` if the policy is a policy server.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CandidateRecord {
    /// The tokens of the completion: reasoning and action.
    pub tokens: Vec<u32>,
    /// Its actions; `None` for a malformed candidate.
    pub actions: Option<ActionChunk>,
    /// The reason why it is malformed.
    pub malformed: Option<String>,
    /// The sections of its reasoning that were only partly read, with reasons. Absent if there are
    /// none, as in every record of a policy whose reasoning is read strictly.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unread: Vec<String>,
    /// The verifier's success probability.
    pub score: Option<f32>,
    /// Log-probability of the sampled tokens at temperature 1.
    pub log_probability: f32,
    /// Log-probability of each token at temperature 1.
    pub log_probabilities: Vec<f32>,
    /// The last token's final hidden state as 16-bit floats in little-endian order; always present
    /// for the executed candidate.
    #[serde(with = "serde_bytes")]
    pub hidden: Option<Vec<u8>>,
    /// What the tokens do not give; absent in every record of a local checkpoint.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reading: Option<Reading>,
}

/// What a policy server sends of a well-formed candidate beside its actions, or what the backbone
/// reads of it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reading {
    /// Empty for a policy that acts without reasoning.
    pub reasoning: Reasoning,
    /// Token ids of the action's bins; empty if the policy has none.
    pub action_tokens: Vec<u32>,
    /// Log-probability of each section of the reasoning and of each dimension of the action; empty
    /// if they are not known.
    pub confidence: Vec<f32>,
}

impl DecisionRecord {
    /// The decision's share of its batch's time.
    pub fn milliseconds(&self) -> f32 {
        self.batch_ms / self.batch_size.max(1) as f32
    }
}

impl EpisodeRecord {
    /// The decisions in order.
    pub fn decisions(&self) -> impl Iterator<Item = &DecisionRecord> {
        self.steps.iter().filter_map(|step| step.decision.as_ref())
    }

    /// Whether the episode has an outcome. Without any well-formed candidate the policy never
    /// controlled the robot.
    pub fn has_outcome(&self) -> bool {
        self.decisions().any(|decision| decision.chosen.is_some())
    }

    /// The mean score of the executed candidates; `None` without a verifier or without any choice.
    pub fn score_mean(&self) -> Option<f32> {
        let chosen = self
            .decisions()
            .filter_map(|decision| decision.candidates.get(decision.chosen? as usize)?.score);
        let (sum, count) =
            chosen.fold((0.0_f32, 0_u32), |(sum, count), score| (sum + score, count + 1));
        (count > 0).then(|| sum / count as f32)
    }
}

/// Encodes a hidden state for a record.
pub fn hidden_to_bytes(hidden: &[f32]) -> Vec<u8> {
    hidden.iter().flat_map(|value| f16::from_f32(*value).to_le_bytes()).collect()
}

/// Decodes a hidden state of a record.
pub fn hidden_from_bytes(bytes: &[u8]) -> Result<Vec<f32>> {
    ensure!(
        bytes.len().is_multiple_of(2),
        "hidden state: expected 16-bit numbers, got {} bytes",
        bytes.len()
    );
    Ok(bytes.chunks_exact(2).map(|pair| f16::from_le_bytes([pair[0], pair[1]]).to_f32()).collect())
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
            unread: Vec::new(),
            score: Some(0.75),
            log_probability: -3.5,
            log_probabilities: vec![-1.0, -2.0, -0.5],
            hidden: Some(hidden_to_bytes(&[0.5, -2.0])),
            reading: None,
        };
        let malformed = CandidateRecord {
            actions: None,
            malformed: Some("expected 7 action tokens, got 6".into()),
            unread: Vec::new(),
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
                commit: "f00d".into(),
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
    fn a_record_has_a_setting_and_a_mean_score() {
        let record = made_up(3);
        assert_eq!(record.score_mean(), Some(0.75));
        let setting = record.identity.setting().expect("a setting");
        assert_eq!(setting.to_string(), "verifier+medoid N=2 T=0.7");
    }

    #[test]
    fn hidden_states_keep_sixteen_bits() {
        let hidden = [0.0, 1.0, -0.333_251_95, 65_504.0];
        assert_eq!(hidden_from_bytes(&hidden_to_bytes(&hidden)).expect("pairs"), hidden);
        assert!(hidden_from_bytes(&[0, 1, 2]).is_err());
    }
}
