//! Recognises checkpoints of other families, and says in one sentence what they are and how they
//! can be run.

use std::path::Path;

use anyhow::{Result, bail};
use serde_json::Value;

use crate::checkpoint::shards;

/// What every policy that is not run here can be.
const SERVE: &str = "run it with its own program as a policy server and give the address: \
    --policy openpi://HOST:PORT, --policy vla-eval://HOST:PORT or --policy http://HOST:PORT/act";

/// Values of `model_type` and what they are. A name that ends in `*` stands for all that begin so.
const MODEL_TYPES: [(&str, &str); 14] = [
    ("prismatic", "a Prismatic vision-language model that was not trained on actions (prism-*)"),
    ("spatialvla", "SpatialVLA, whose PaliGemma backbone and action grid are not OpenVLA's"),
    ("molmoact", "MolmoAct, whose reasoning is depth and trace tokens"),
    ("cogact", "CogACT, whose actions come from a diffusion head"),
    ("tracevla*", "TraceVLA, which looks at two images"),
    ("phi3_v", "a Phi-3-Vision model, such as TraceVLA's or OpenVLA's with Phi-3"),
    ("paligemma*", "a PaliGemma model, the backbone of pi0 and SpatialVLA"),
    ("gr00t*", "GR00T, whose actions come from a diffusion head"),
    ("pi0*", "pi0, whose actions come from a flow-matching head"),
    ("smolvla", "SmolVLA, whose actions come from a flow-matching head"),
    ("qwen2*", "a Qwen2 model, such as NORA's, not in OpenVLA's layout"),
    ("llama", "a Llama language model without images and actions"),
    ("mistral", "a Mistral language model without images and actions"),
    ("kosmos*", "a Kosmos model, such as RoboVLMs'"),
];

/// Files of OpenVLA-OFT's heads begin with one of these.
const OFT_FILES: [&str; 4] =
    ["action_head--", "proprio_projector--", "noisy_action_projector--", "vision_backbone--"];
/// TraceVLA's embedding between its two images.
const TRACEVLA_TENSOR: &str = "vision_backbone.sep_tok.weight";
/// Endings of the names of tensors that quantised files have.
const QUANTISED_ENDINGS: [&str; 5] = [".SCB", ".absmax", ".quant_map", ".qweight", ".qzeros"];

/// Refuses every family but OpenVLA's.
pub fn check(directory: &Path, config: &Value) -> Result<()> {
    match config.get("model_type").and_then(Value::as_str) {
        Some("openvla") => {}
        Some(other) => {
            let is = |(name, _): &&(&str, &str)| match name.strip_suffix('*') {
                Some(start) => other.starts_with(start),
                None => other == *name,
            };
            let found = MODEL_TYPES.iter().find(is).map(|(_, what)| format!("this is {what}; "));
            let what = found.unwrap_or_default();
            bail!("model_type: expected openvla, got {other}; {what}{SERVE}");
        }
        None => bail!("model_type: expected openvla, got none; {}{SERVE}", untyped(config)),
    }
    check_language_model(config)?;
    if let Some(quantisation) = config.get("quantization_config").filter(|value| !value.is_null()) {
        let method = quantisation.get("quant_method").and_then(Value::as_str).unwrap_or("unknown");
        bail!(
            "quantization_config: expected weights of 16 or 32 bits, got {method}; download the checkpoint that was \
             not quantised"
        );
    }
    check_files(directory)
}

/// What a file without `model_type` is, as the beginning of a sentence.
fn untyped(config: &Value) -> String {
    let has = |field: &str| config.get(field).is_some();
    let what = if has("type") && (has("input_features") || has("output_features")) {
        let kind = config["type"].as_str().unwrap_or("unknown");
        format!("a LeRobot policy of type {kind} (such as pi0, SmolVLA, ACT or diffusion)")
    } else if has("robovlm_name") || has("act_head") {
        "a RoboVLMs policy".to_owned()
    } else if has("action_model_type") || has("future_action_window_size") {
        "CogACT in Prismatic's own format, whose actions come from a diffusion head".to_owned()
    } else if has("vla") {
        "a policy in Prismatic's own format (.pt, such as MiniVLA or a steerable OpenVLA); OpenVLA's \
         convert_openvla_weights_to_hf.py converts those with Llama 2 or Vicuna"
            .to_owned()
    } else if has("model") && has("stage") {
        "a Prismatic vision-language model that was not trained on actions (prism-*)".to_owned()
    } else if has("model") && (has("text_processor") || has("window_size") || has("dataset_kwargs"))
    {
        "an Octo policy".to_owned()
    } else {
        return String::new();
    };
    format!("this is {what}; ")
}

/// OpenVLA's layout with another language model.
fn check_language_model(config: &Value) -> Result<()> {
    let kind = config.get("text_config").and_then(|text| text.get("model_type"));
    match kind.and_then(Value::as_str) {
        None | Some("llama") => Ok(()),
        Some(other) => {
            let what = if other.starts_with("qwen2") { "; this is MiniVLA" } else { "" };
            bail!("text_config.model_type: expected llama, got {other}{what}; {SERVE}")
        }
    }
}

/// Policies with OpenVLA's `config.json` that need more than its files.
fn check_files(directory: &Path) -> Result<()> {
    for name in names(directory) {
        if OFT_FILES.iter().any(|start| name.starts_with(start)) && name.ends_with(".pt") {
            bail!(
                "{name}: this is an OpenVLA-OFT checkpoint, whose actions come from a continuous head that is not run \
                 here; {SERVE}"
            );
        }
    }
    // Names that cannot be read are reported by the loader.
    for tensor in shards::tensor_names(directory).unwrap_or_default() {
        if tensor == TRACEVLA_TENSOR {
            bail!(
                "{tensor}: this is TraceVLA, which looks at a second image with visual traces; {SERVE}"
            );
        }
        if QUANTISED_ENDINGS.iter().any(|ending| tensor.ends_with(ending)) {
            bail!(
                "{tensor}: expected weights of 16 or 32 bits, got quantised ones; download the checkpoint that was not \
                 quantised"
            );
        }
    }
    Ok(())
}

/// Says what a folder without `config.json` is, if it is known.
pub fn refuse_without_config(directory: &Path) -> Result<()> {
    let names = names(directory);
    let has = |name: &str| names.iter().any(|one| one == name);
    if has("adapter_config.json") {
        bail!(
            "adapter_config.json without config.json: this is a LoRA adapter alone; merge it into its base checkpoint \
             (peft's merge_and_unload, which OpenVLA's finetune.py also does) and give the merged folder"
        );
    }
    if has("saved_model.pb") {
        bail!("saved_model.pb: this is a TensorFlow policy, such as RT-1-X; {SERVE}");
    }
    if has("params") || has("_METADATA") {
        bail!(
            "expected config.json, got a JAX checkpoint, such as pi0 in openpi's format; {SERVE}"
        );
    }
    Ok(())
}

/// The names in a folder; none if it cannot be read, which the next step reports.
fn names(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let mut names: Vec<String> =
        entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}
