//! The identity of an episode, and its name in files and links.

use std::fmt::Write;

use anyhow::Result;
use decision::{Setting, Strategy, TaskId};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// Longer names would exceed the limit of file names once suffixes are added.
const ID_BYTES_MAX: usize = 200;

/// Everything that determines the course of an episode is here or in
/// [`Versions`](crate::record::Versions).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeIdentity {
    /// The run of the episode.
    pub run: String,
    /// The task's name.
    pub task: String,
    /// The task's variant.
    pub variant: String,
    /// Number of the task's fixed initial layout; `None` for a random one generated from `seed`.
    pub layout: Option<u32>,
    /// Number within task and variant. Equal numbers in one run are paired.
    pub episode: u32,
    /// Seed of the environment.
    pub seed: u64,
    /// Seed of the policy's sampling, the same for every strategy.
    pub sampling_seed: u64,
    /// The strategy that selected the candidates.
    pub strategy: String,
    /// Candidates per step.
    pub candidates: u32,
    /// Sampling temperature; 0 is greedy.
    pub temperature: f32,
}

impl EpisodeIdentity {
    /// The episode's name within its run. It is a file name and part of a link, so it contains only
    /// `a-z A-Z 0-9 . _ - ~`. Different episodes of a run have different names. Bytes of a task or
    /// variant other than `a-z A-Z 0-9 . _` are written as `~` and two hexadecimal digits, because
    /// `-` separates the parts.
    pub fn id(&self) -> String {
        let id = format!(
            "{}-{}-{:04}-{}-n{}-t{}",
            escaped(&self.task, ""),
            escaped(&self.variant, ""),
            self.episode,
            escaped(&self.strategy, "-").replace('_', "~5F").replace("~2B", "_"),
            self.candidates,
            self.temperature
        );
        if id.len() <= ID_BYTES_MAX {
            return id;
        }
        // No escaped text contains `~~`, so a shortened name never equals another one.
        let digest = crate::digest::hex(&Sha256::digest(&id)[..16]);
        format!("{}~~{digest}", &id[..ID_BYTES_MAX - 34])
    }

    /// The setting of the episode.
    pub fn setting(&self) -> Result<Setting> {
        let strategy: Strategy = self.strategy.parse()?;
        Ok(Setting { strategy, candidates: self.candidates, temperature: self.temperature })
    }

    /// The task of the episode.
    pub fn task_id(&self) -> TaskId {
        TaskId::new(&self.task, &self.variant)
    }
}

/// Keeps ASCII letters, digits, `_`, any `.` but a leading one, and the characters in `also`;
/// escapes the rest.
fn escaped(text: &str, also: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for (index, byte) in text.bytes().enumerate() {
        let is_inner_dot = byte == b'.' && index > 0;
        if byte.is_ascii_alphanumeric()
            || byte == b'_'
            || is_inner_dot
            || also.as_bytes().contains(&byte)
        {
            escaped.push(char::from(byte));
        } else {
            let _ = write!(escaped, "~{byte:02X}");
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    fn id(task: &str, variant: &str, strategy: &str) -> String {
        let identity = EpisodeIdentity {
            run: "run".into(),
            task: task.into(),
            variant: variant.into(),
            layout: None,
            episode: 7,
            seed: 1,
            sampling_seed: 2,
            strategy: strategy.into(),
            candidates: 5,
            temperature: 0.7,
        };
        identity.id()
    }

    #[test]
    fn names_of_bridge_tasks_do_not_change() {
        let check = |strategy, expected: &str| {
            let named = id("widowx_stack_cube", "default", strategy);
            assert_eq!(named, format!("widowx_stack_cube-default-0007-{expected}-n5-t0.7"));
        };
        check("sample", "sample");
        check("verifier+medoid", "verifier_medoid");
        check("first-well-formed", "first-well-formed");
    }

    #[test]
    fn names_are_valid_file_names_and_unique() {
        let long = "x".repeat(128);
        let texts = [
            "ALE/Pong-v5",
            "ALE_Pong-v5",
            "ALE~2FPong-v5",
            "a",
            "a-b",
            "b-c",
            "c",
            "..",
            ".",
            "a/../../b",
            "sp ace",
            "ü",
            "\u{fc}x",
            "~",
            "~~",
            "A\0",
            "0000",
            "a-default-0007",
            "verifier+medoid",
            "verifier_medoid",
            "verifier~5Fmedoid",
            &long,
            &long[1..],
        ];
        let mut ids = BTreeSet::new();
        for task in texts {
            for variant in texts {
                for strategy in texts {
                    ids.insert(id(task, variant, strategy));
                }
            }
        }
        assert_eq!(ids.len(), texts.len().pow(3));
        let is_safe = |letter: char| letter.is_ascii_alphanumeric() || "._-~".contains(letter);
        for id in ids {
            assert!(id.len() <= ID_BYTES_MAX && id.chars().all(is_safe), "{id}");
            assert!(!id.starts_with('.'), "{id}");
        }
        assert_eq!(
            id("ALE/Pong-v5", "default", "greedy"),
            "ALE~2FPong~2Dv5-default-0007-greedy-n5-t0.7"
        );
    }
}
