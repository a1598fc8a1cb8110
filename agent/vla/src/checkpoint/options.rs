//! Options that settle what a checkpoint's files leave open. They decide what is computed, so they
//! are part of the checkpoint's identity.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// How to read a checkpoint. The default reads everything from its files.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LoadOptions {
    /// The dataset whose statistics scale the actions.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unnorm_key: Option<String>,
    /// Whether completions contain a chain of thought.
    #[serde(skip_serializing_if = "ReasoningMode::is_auto")]
    pub reasoning: ReasoningMode,
    /// The prompt, with `{instruction}` once.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prompt: Option<String>,
    /// Maximum tokens of a completion.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_new_tokens: Option<usize>,
    /// Whether images are cropped to the central 90 % of their area and enlarged again.
    #[serde(skip_serializing_if = "is_false")]
    pub center_crop: bool,
}

/// Whether a checkpoint writes a chain of thought before its action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ReasoningMode {
    /// As its files say, or as its published family does.
    #[default]
    Auto,
    /// It does.
    On,
    /// It does not.
    Off,
}

impl ReasoningMode {
    /// All modes, in the order of the help.
    pub const ALL: [ReasoningMode; 3] =
        [ReasoningMode::Auto, ReasoningMode::On, ReasoningMode::Off];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            ReasoningMode::Auto => "auto",
            ReasoningMode::On => "on",
            ReasoningMode::Off => "off",
        }
    }

    fn is_auto(&self) -> bool {
        *self == ReasoningMode::Auto
    }
}

impl fmt::Display for ReasoningMode {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.pad(self.name())
    }
}

impl FromStr for ReasoningMode {
    type Err = String;

    fn from_str(text: &str) -> Result<ReasoningMode, String> {
        let found = ReasoningMode::ALL.into_iter().find(|mode| mode.name() == text);
        found.ok_or_else(|| format!("expected auto, on or off, got {text:?}"))
    }
}

fn is_false(value: &bool) -> bool {
    !value
}
