//! Loading checkpoints: every weight is used or known to be unused, and unknown layouts are
//! refused.

use std::collections::HashMap;

use anyhow::Result;

use super::*;
use crate::checkpoint::config::Config;

/// Loads a copy of a tiny checkpoint with changed weights and configuration.
pub fn load_changed(
    name: &str,
    weights: impl FnOnce(&mut HashMap<String, Tensor>) -> Result<()>,
    config: impl FnOnce(&mut serde_json::Value),
) -> Result<Vla> {
    let (source, directory) = (fixtures().join(name), tempfile::tempdir()?);
    let mut tensors =
        candle_core::safetensors::load(source.join("model.safetensors"), &Device::Cpu)?;
    weights(&mut tensors)?;
    candle_core::safetensors::save(&tensors, directory.path().join("model.safetensors"))?;
    let text = std::fs::read_to_string(source.join("config.json"))?;
    let mut value: serde_json::Value = serde_json::from_str(&text)?;
    config(&mut value);
    std::fs::write(directory.path().join("config.json"), value.to_string())?;
    std::fs::copy(source.join("tokenizer.json"), directory.path().join("tokenizer.json"))?;
    Vla::load(directory.path(), DeviceName::Cpu, &LoadOptions::default())
}

/// Loads a tiny checkpoint as it is, with options.
pub fn load_with(name: &str, options: &LoadOptions) -> Result<Vla> {
    Vla::load_on(&fixtures().join(name), &Device::Cpu, Backend::Kernels, options)
}

pub fn refusal(policy: Result<Vla>) -> String {
    match policy {
        // The outermost context contains a temporary path.
        Err(error) => error.chain().skip(1).map(ToString::to_string).collect::<Vec<_>>().join(": "),
        Ok(_) => "accepted".to_string(),
    }
}

pub fn identity(policy: Result<Vla>) -> Result<String> {
    Ok(policy?.parser().digest().to_owned())
}

fn halve(tensors: &mut HashMap<String, Tensor>) -> Result<()> {
    for tensor in tensors.values_mut() {
        *tensor = tensor.to_dtype(DType::BF16)?;
    }
    Ok(())
}

#[test]
fn sixteen_bit_weights_load() -> Result<()> {
    let policy = load_changed("tiny", halve, |_| {});
    assert_ne!(identity(policy)?, identity(tiny("tiny", Backend::Kernels))?);
    Ok(())
}

#[test]
fn the_identity_does_not_depend_on_how_files_are_written() -> Result<()> {
    let expected = identity(tiny("tiny", Backend::Kernels))?;
    let unread = |config: &mut serde_json::Value| {
        config["transformers_version"] = "4.40.1".into();
        let statistics = config["norm_stats"].as_object().and_then(|all| all.values().next());
        let mut other = statistics.expect("a dataset").clone();
        other["action"]["q01"][0] = (-7.5).into();
        let only = config["norm_stats"].as_object().and_then(|all| all.keys().next());
        config["unnorm_key"] = only.expect("a dataset").clone().into();
        config["norm_stats"]["another_dataset"] = other;
    };
    assert_eq!(identity(load_changed("tiny", |_| Ok(()), unread))?, expected, "unused fields");

    let wide = |tensors: &mut HashMap<String, Tensor>| -> Result<()> {
        halve(tensors)?;
        for tensor in tensors.values_mut() {
            *tensor = tensor.to_dtype(DType::F32)?;
        }
        Ok(())
    };
    let halved = identity(load_changed("tiny", halve, |_| {}))?;
    assert_eq!(identity(load_changed("tiny", wide, |_| {}))?, halved, "the same values, wider");

    let directory = tempfile::tempdir()?;
    let source = fixtures().join("tiny");
    std::fs::copy(source.join("config.json"), directory.path().join("config.json"))?;
    let tokenizer: serde_json::Value =
        serde_json::from_slice(&std::fs::read(source.join("tokenizer.json"))?)?;
    let indented = serde_json::to_string_pretty(&tokenizer)?;
    std::fs::write(directory.path().join("tokenizer.json"), indented)?;
    let tensors = candle_core::safetensors::load(source.join("model.safetensors"), &Device::Cpu)?;
    let mut weight_map = HashMap::new();
    let mut shards = [HashMap::new(), HashMap::new()];
    for (name, tensor) in tensors {
        let shard = name.len() % 2;
        weight_map.insert(name.clone(), format!("{shard}.safetensors"));
        shards[shard].insert(name, tensor);
    }
    for (index, shard) in shards.iter().enumerate() {
        candle_core::safetensors::save(
            shard,
            directory.path().join(format!("{index}.safetensors")),
        )?;
    }
    let index = serde_json::json!({ "weight_map": weight_map });
    std::fs::write(directory.path().join("model.safetensors.index.json"), index.to_string())?;
    let sharded = identity(Vla::load(directory.path(), DeviceName::Cpu, &LoadOptions::default()))?;
    assert_eq!(sharded, expected, "shards, indentation");
    Ok(())
}

#[test]
fn a_different_computation_has_a_different_identity() -> Result<()> {
    let expected = identity(tiny("tiny", Backend::Kernels))?;
    let one_weight = |tensors: &mut HashMap<String, Tensor>| -> Result<()> {
        let bias = tensors.get_mut("projector.fc2.bias").expect("a bias");
        *bias = (bias.clone() + 1e-3)?;
        Ok(())
    };
    assert_ne!(identity(load_changed("tiny", one_weight, |_| {}))?, expected);
    let changes: [fn(&mut serde_json::Value); 4] = [
        |config| config["prompt_template"] = "{instruction}".into(),
        |config| config["max_new_tokens"] = 17.into(),
        |config| config["text_config"]["rope_theta"] = 9999.0.into(),
        |config| {
            let datasets = config["norm_stats"].as_object_mut().expect("datasets");
            for dataset in datasets.values_mut() {
                dataset["action"]["q99"][0] = 7.5.into();
            }
        },
    ];
    for (index, change) in changes.into_iter().enumerate() {
        assert_ne!(identity(load_changed("tiny", |_| Ok(()), change))?, expected, "{index}");
    }
    Ok(())
}

#[test]
fn unused_weights_are_not_part_of_the_identity() -> Result<()> {
    let dead = |tensors: &mut HashMap<String, Tensor>| -> Result<()> {
        let norm = tensors.get_mut("vision_backbone.featurizer.norm.bias").expect("a dead weight");
        *norm = (norm.clone() + 1.0)?;
        Ok(())
    };
    let expected = identity(tiny("tiny-fused", Backend::Kernels))?;
    assert_eq!(identity(load_changed("tiny-fused", dead, |_| {}))?, expected);
    Ok(())
}

#[test]
fn weights_that_do_not_fit_are_refused() -> Result<()> {
    let check = |change: fn(&mut HashMap<String, Tensor>) -> Result<()>, expected: &str| {
        assert_eq!(refusal(load_changed("tiny", change, |_| {})), expected);
    };
    check(
        |tensors| {
            tensors.remove("projector.fc2.bias");
            Ok(())
        },
        "weights: expected projector.fc2.bias of shape [32], got none",
    );
    check(
        |tensors| {
            let extra = tensors["projector.fc2.bias"].clone();
            tensors.insert("projector.fc3.bias".to_string(), extra);
            Ok(())
        },
        "weights: expected only known tensors, got 1 others, such as projector.fc3.bias",
    );
    check(
        |tensors| {
            let narrow = tensors["projector.fc2.bias"].narrow(0, 0, 31)?;
            tensors.insert("projector.fc2.bias".to_string(), narrow.contiguous()?);
            Ok(())
        },
        "projector.fc2.bias: expected [32], got [31]",
    );
    Ok(())
}

#[test]
fn unknown_layouts_are_refused_with_a_reason() {
    fn check(change: impl FnOnce(&mut serde_json::Value), expected: &str) {
        let got = refusal(load_changed("tiny", |_| Ok(()), change));
        assert!(got.contains(expected), "expected {expected:?}, got {got:?}");
    }
    check(|c| c["model_type"] = "llava".into(), "model_type: expected openvla, got llava");
    check(
        |c| c["timm_model_ids"] = vec!["vit_huge"].into(),
        "accepted", // vision_config describes it
    );
    check(
        |c| c["vision_config"] = serde_json::Value::Null,
        "timm_model_ids: expected a known tower or one described in vision_config, got rever_vit",
    );
    check(
        |c| c["vision_config"]["window"] = 7.into(),
        "unknown field `window`, expected one of `image_size`, `patch_size`, `embed_dim`, \
         `depth`, `num_heads`, `mlp_ratio`, `class_token`, `registers`, `layer_scale`",
    );
    check(
        |c| c["image_resize_strategy"] = "stretch".into(),
        "image_resize_strategy: expected resize-naive or letterbox, got stretch",
    );
    check(
        |c| c["text_config"]["hidden_act"] = "gelu".into(),
        "hidden_act: expected silu, got gelu",
    );
    check(
        |c| c["text_config"]["rope_scaling"] = "dynamic".into(),
        "rope_scaling: expected none, got \"dynamic\"",
    );
    check(
        |c| c["unnorm_key"] = "bridge_orig".into(),
        "unnorm_key: expected one of [\"rever_bridge\"] (norm_stats of config.json), got \"bridge_orig\"",
    );
    check(
        |c| c["prompt_template"] = serde_json::Value::Null,
        "prompt_template: expected one, because llm_backbone_id \"rever-llama\" is unknown",
    );
    check(
        |c| c["pad_to_multiple_of"] = 128.into(),
        "tokenizer.json: expected 896 tokens and at most one for padding, got 960",
    );
}

#[test]
fn openvla_7b_is_a_known_layout() -> Result<()> {
    // The fields of openvla-7b's config.json that determine its layout; its text_config contains
    // only what differs from Hugging Face's defaults.
    let text = r#"{"model_type": "openvla", "llm_backbone_id": "llama2-7b-pure",
        "timm_model_ids": ["vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"],
        "timm_override_act_layers": [null, null], "use_fused_vision_backbone": true,
        "image_sizes": [224, 224], "image_resize_strategy": "resize-naive",
        "text_config": {"model_type": "llama", "vocab_size": 32064, "pad_token_id": 32000},
        "pad_to_multiple_of": 64, "n_action_bins": 256,
        "norm_stats": {"bridge_orig": {"action": {"q01": [-1,-1,-1,-1,-1,-1,0],
            "q99": [1,1,1,1,1,1,1], "mask": [true,true,true,true,true,true,false]}}}}"#;
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("config.json");
    std::fs::write(&path, text)?;
    let config = Config::load(directory.path(), &LoadOptions::default())?;
    assert_eq!(config.vocabulary, 32000);
    assert_eq!(config.towers.iter().map(|tower| tower.embed_dim).sum::<usize>(), 2176);
    assert_eq!(config.towers.iter().map(|tower| tower.depth - 2).collect::<Vec<_>>(), [22, 25]);
    assert_eq!(config.towers[1].mlp_width(), 4304);
    assert_eq!(config.towers[1].head_shape().size, 72);
    assert_eq!((config.text.num_hidden_layers, config.text.rms_norm_eps), (32, 1e-6));
    assert!(config.prompt_template.starts_with("In: What action"));
    assert!(!config.reasoning && config.completion_tokens_max == 8);
    Ok(())
}
