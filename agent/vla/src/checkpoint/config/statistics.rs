//! The statistics that scale actions: which file they are in, and which dataset's are used.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, anyhow, ensure};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::ACTION_LENGTH;
use crate::checkpoint::options::LoadOptions;

/// The file that OpenVLA's fine-tuning writes beside `config.json`. Its own evaluation prefers it.
const STATISTICS_FILE: &str = "dataset_statistics.json";
/// The dataset to name in messages if a checkpoint has it: the tasks that come with the program
/// are Bridge's.
const EXAMPLE: &str = "bridge_orig";

/// The scale from normalised to physical actions: 1st and 99th percentile of the training data.
#[derive(Debug, Clone, Serialize)]
pub struct ActionScale {
    pub q01: [f64; ACTION_LENGTH],
    pub q99: [f64; ACTION_LENGTH],
    /// False for a dimension that is not normalised.
    pub mask: [bool; ACTION_LENGTH],
}

/// The statistics of all datasets of a checkpoint. Only those of the chosen one are parsed.
pub struct Datasets<'a> {
    by_name: std::borrow::Cow<'a, BTreeMap<String, Value>>,
    /// Where they are.
    place: &'static str,
}

#[derive(Deserialize)]
struct ActionStatistics {
    q01: Vec<f64>,
    q99: Vec<f64>,
    /// All true if it is missing, as in the reference.
    mask: Option<Vec<bool>>,
}

impl<'a> Datasets<'a> {
    /// Those of `dataset_statistics.json` if there is one, otherwise those of `config.json`.
    pub fn find(directory: &Path, config: &'a BTreeMap<String, Value>) -> Result<Datasets<'a>> {
        let path = directory.join(STATISTICS_FILE);
        if !path.is_file() {
            let by_name = std::borrow::Cow::Borrowed(config);
            return Ok(Datasets { by_name, place: "norm_stats of config.json" });
        }
        let read = || -> Result<BTreeMap<String, Value>> {
            Ok(serde_json::from_slice(&std::fs::read(&path)?)?)
        };
        let by_name = read().with_context(|| format!("cannot use {STATISTICS_FILE}"))?;
        Ok(Datasets { by_name: std::borrow::Cow::Owned(by_name), place: STATISTICS_FILE })
    }

    /// Whether they are those of `config.json`.
    pub fn are_of_config(&self) -> bool {
        matches!(self.by_name, std::borrow::Cow::Borrowed(_))
    }

    /// The scale of the dataset that the options or else `config.json` name, or of the only one.
    pub fn action_scale(&self, options: &LoadOptions, named: Option<&str>) -> Result<ActionScale> {
        let mut names = self.by_name.keys().map(String::as_str);
        let only = match (names.next(), names.next()) {
            (Some(only), None) => Some(only),
            _ => None,
        };
        let named = options.unnorm_key.as_deref().or(named);
        let key = named.or(only).ok_or_else(|| self.refusal("none"))?;
        let statistics = self.by_name.get(key).ok_or_else(|| self.refusal(&format!("{key:?}")))?;
        action_scale(statistics).with_context(|| format!("statistics of {key} in {}", self.place))
    }

    fn refusal(&self, got: &str) -> anyhow::Error {
        let names: Vec<&String> = self.by_name.keys().collect();
        let example = names.iter().find(|name| name.as_str() == EXAMPLE).or(names.first());
        let Some(example) = example else {
            return anyhow!(
                "unnorm_key: expected statistics of a dataset in {}, got none; a pretrained checkpoint has none \
                 before it is trained on actions",
                self.place
            );
        };
        anyhow!(
            "unnorm_key: expected one of {names:?} ({}), got {got}; choose the dataset whose actions the robot takes, \
             such as --unnorm-key {example}",
            self.place
        )
    }
}

fn action_scale(dataset: &Value) -> Result<ActionScale> {
    let action = dataset.get("action").context("expected a field action, got none")?;
    let ActionStatistics { q01, q99, mask } = ActionStatistics::deserialize(action)?;
    let scale = ActionScale {
        q01: seven("q01", q01)?,
        q99: seven("q99", q99)?,
        mask: mask.map_or(Ok([true; ACTION_LENGTH]), |mask| seven("mask", mask))?,
    };
    let finite = scale.q01.iter().chain(&scale.q99).all(|number| number.is_finite());
    ensure!(finite, "expected finite q01 and q99, got {scale:?}");
    Ok(scale)
}

fn seven<T>(name: &str, values: Vec<T>) -> Result<[T; ACTION_LENGTH]> {
    let count = values.len();
    values.try_into().map_err(|_| {
        anyhow!(
            "{name}: expected {ACTION_LENGTH} numbers (translation, rotation, gripper), got {count}"
        )
    })
}
