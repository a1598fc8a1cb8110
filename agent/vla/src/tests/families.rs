//! Checkpoints of other families: each is refused in one sentence that says what it is and how it
//! can be run.

use serde_json::{Value, json};

use super::*;
use crate::checkpoint::config::Config;

/// Refuses a folder with this config.json (if any) and these other files.
fn refusal(config: Option<&Value>, files: &[&str]) -> Result<String> {
    let directory = tempfile::tempdir()?;
    if let Some(config) = config {
        std::fs::write(directory.path().join("config.json"), config.to_string())?;
    }
    for name in files {
        std::fs::write(directory.path().join(name), "")?;
    }
    let error = Config::load(directory.path(), &LoadOptions::default()).err();
    Ok(format!("{:#}", error.context("it is refused")?))
}

#[test]
fn every_known_family_is_named_and_told_how_it_can_be_run() -> Result<()> {
    // The fields by which each is recognised.
    let families = [
        (
            json!({"model_type": "prismatic", "norm_stats": {}}),
            "was not trained on actions (prism-*)",
        ),
        (
            json!({"model": {"model_id": "prism-dinosiglip-224px+7b"}, "stage": "finetune"}),
            "(prism-*)",
        ),
        (json!({"vla": {"vla_id": "minivla"}, "data_root_dir": "x"}), "Prismatic's own format"),
        (json!({"vla": {"type": "prism"}, "action_model_type": "DiT-B"}), "CogACT"),
        (json!({"model_type": "cogact"}), "CogACT"),
        (json!({"model_type": "openvla", "text_config": {"model_type": "qwen2"}}), "MiniVLA"),
        (json!({"model_type": "openvla", "text_config": {"model_type": "mistral"}}), "got mistral"),
        (
            json!({"model_type": "spatialvla", "vision_config": {"model_type": "siglip"}}),
            "SpatialVLA",
        ),
        (json!({"model_type": "molmoact", "vit_config": {}}), "MolmoAct"),
        (json!({"model_type": "gr00t_n1_5"}), "GR00T"),
        (json!({"model_type": "phi3_v"}), "TraceVLA"),
        (json!({"robovlm_name": "RoboKosMos", "act_head": {}, "vlm": {}}), "RoboVLMs"),
        (
            json!({"type": "pi0", "input_features": {}, "output_features": {}}),
            "LeRobot policy of type pi0",
        ),
        (json!({"type": "smolvla", "input_features": {}}), "LeRobot policy of type smolvla"),
        (json!({"model": {"heads": {}}, "text_processor": {}, "window_size": 2}), "Octo"),
        (json!({"model_type": "llama"}), "without images and actions"),
        (json!({"model_type": "something_new"}), "expected openvla, got something_new"),
        (json!({"n_layers": 3}), "expected openvla, got none"),
    ];
    for (config, expected) in &families {
        let refused = refusal(Some(config), &[])?;
        assert!(refused.contains(expected), "{config}: {refused}");
        assert!(refused.contains("--policy vla-eval://HOST:PORT"), "{config}: {refused}");
    }
    Ok(())
}

#[test]
fn policies_with_openvlas_configuration_and_other_inputs_are_recognised_by_their_files()
-> Result<()> {
    let config = json!({"model_type": "openvla", "text_config": {"model_type": "llama"}});
    let oft = refusal(Some(&config), &["action_head--150000_checkpoint.pt"])?;
    assert!(oft.contains("OpenVLA-OFT") && oft.contains("--policy openpi://"), "{oft}");
    let oft = refusal(Some(&config), &["proprio_projector--150000_checkpoint.pt"])?;
    assert!(oft.contains("OpenVLA-OFT"), "{oft}");
    let directory = tempfile::tempdir()?;
    std::fs::write(directory.path().join("config.json"), config.to_string())?;
    let index =
        json!({"weight_map": {"vision_backbone.sep_tok.weight": "model-00001.safetensors"}});
    std::fs::write(directory.path().join("model.safetensors.index.json"), index.to_string())?;
    let error = Config::load(directory.path(), &LoadOptions::default()).err();
    let traces = format!("{:#}", error.context("it is refused")?);
    assert!(traces.contains("this is TraceVLA, which looks at a second image"), "{traces}");
    Ok(())
}

#[test]
fn folders_without_a_configuration_are_named() -> Result<()> {
    for (file, expected) in [
        ("adapter_config.json", "a LoRA adapter alone; merge it into its base checkpoint"),
        ("saved_model.pb", "a TensorFlow policy, such as RT-1-X"),
        ("_METADATA", "a JAX checkpoint, such as pi0 in openpi's format"),
        ("notes.txt", "cannot read"),
    ] {
        let refused = refusal(None, &[file])?;
        assert!(refused.contains(expected), "{file}: {refused}");
    }
    Ok(())
}
