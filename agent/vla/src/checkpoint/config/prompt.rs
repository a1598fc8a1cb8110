//! The prompt of a checkpoint and whether it writes a chain of thought, from its files and options.
//!
//! Published files do not say whether they reason. `auto` recognises what is published and refuses
//! to guess for the rest:
//!
//! - a prompt that ends in `TASK:` asks for a chain of thought;
//! - Llama 2 (`llama2-7b-pure`) is OpenVLA's and does not reason, unless its statistics name
//!   `bridge_reasoning`, the dataset of ECoT's evaluation script;
//! - Vicuna (`vicuna-v15-7b`) with one SigLIP tower is ECoT's Bridge checkpoint if its statistics
//!   are `bridge_orig`'s alone, and openvla-v01-7b if they are of several datasets.

use anyhow::{Result, bail, ensure};

use super::TowerConfig;
use super::file::File;
use crate::checkpoint::options::{LoadOptions, ReasoningMode};

/// OpenVLA's prompt.
const OPENVLA: &str = "In: What action should the robot take to {instruction}?\nOut:";
/// The prompt of openvla-v01-7b.
const VICUNA: &str = "A chat between a curious user and an artificial intelligence assistant. \
    The assistant gives helpful, detailed, and polite answers to the user's questions. \
    USER: What action should the robot take to {instruction}? ASSISTANT:";
/// What ECoT appends to either prompt: the completion continues its first section.
const ECOT_SUFFIX: &str = " TASK:";
/// The dataset of ECoT's checkpoints with Llama 2.
const ECOT_DATASET: &str = "bridge_reasoning";

/// How a checkpoint is asked.
pub struct Prompt {
    pub template: String,
    /// Whether it answers with a chain of thought before the action.
    pub reasoning: bool,
}

/// Decides from the options, then from `config.json`, then from what is published.
pub fn choose(
    file: &File,
    towers: &[TowerConfig],
    statistics_in_config: bool,
    options: &LoadOptions,
) -> Result<Prompt> {
    let given = options.prompt.as_ref().or(file.prompt_template.as_ref());
    let opens = given.map(|template| template.ends_with(ECOT_SUFFIX.trim_start()));
    let reasoning = match (options.reasoning, file.reasoning, opens) {
        (ReasoningMode::On, ..) => true,
        (ReasoningMode::Off, ..) => false,
        (ReasoningMode::Auto, Some(reasoning), _) => reasoning,
        (ReasoningMode::Auto, None, Some(true)) => true,
        (ReasoningMode::Auto, None, _) => published(file, towers, statistics_in_config)?,
    };
    let template = match (given, file.llm_backbone_id.as_str()) {
        (Some(template), _) => template.clone(),
        (None, "llama2-7b-pure") => of_family(OPENVLA, reasoning),
        (None, "vicuna-v15-7b") => of_family(VICUNA, reasoning),
        (None, other) => bail!(
            "prompt_template: expected one, because llm_backbone_id {other:?} is unknown; give the prompt that the \
             checkpoint was trained with: --prompt 'TEXT {{instruction}} TEXT'"
        ),
    };
    ensure!(
        template.matches("{instruction}").count() == 1,
        "prompt_template: expected {{instruction}} once, got {template:?}"
    );
    Ok(Prompt { template, reasoning })
}

fn of_family(prompt: &str, reasoning: bool) -> String {
    format!("{prompt}{}", if reasoning { ECOT_SUFFIX } else { "" })
}

/// Whether a published checkpoint with such files reasons.
fn published(file: &File, towers: &[TowerConfig], statistics_in_config: bool) -> Result<bool> {
    let datasets: Vec<&str> = file.norm_stats.keys().map(String::as_str).collect();
    if file.llm_backbone_id != "vicuna-v15-7b" {
        return Ok(datasets.contains(&ECOT_DATASET));
    }
    let is_siglip_alone = towers.len() == 1 && !towers[0].is_dino();
    match datasets.as_slice() {
        // A fine-tune has statistics in a file of its own; config.json is then its ancestor's.
        ["bridge_orig"] if is_siglip_alone && statistics_in_config => Ok(true),
        [_, _, ..] if is_siglip_alone && statistics_in_config => Ok(false),
        _ => bail!(
            "reasoning: config.json does not say whether this checkpoint writes a chain of thought, and it is neither \
             ECoT's Bridge checkpoint nor openvla-v01-7b; type --reasoning on (ECoT: the prompt ends in \"ASSISTANT: \
             TASK:\") or --reasoning off (OpenVLA: the prompt ends in \"ASSISTANT:\")"
        ),
    }
}
