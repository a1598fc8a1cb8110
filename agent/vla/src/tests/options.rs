//! Options that settle what a checkpoint's files leave open: statistics, chain of thought, prompt,
//! limit, crop. They are part of the identity.

use serde_json::{Value, json};

use super::checkpoint::{identity, load_changed, load_with, refusal};
use super::*;
use crate::ReasoningMode;
use crate::checkpoint::config::Config;

/// The fields of OpenVLA-7B's config.json that determine its layout.
fn openvla() -> Value {
    json!({
        "model_type": "openvla", "llm_backbone_id": "llama2-7b-pure",
        "timm_model_ids": ["vit_large_patch14_reg4_dinov2.lvd142m", "vit_so400m_patch14_siglip_224"],
        "timm_override_act_layers": [null, null], "use_fused_vision_backbone": true,
        "image_sizes": [224, 224], "image_resize_strategy": "resize-naive",
        "text_config": {"model_type": "llama", "vocab_size": 32064, "pad_token_id": 32000},
        "pad_to_multiple_of": 64, "n_action_bins": 256,
        "norm_stats": {"bridge_orig": statistics(1.0), "kuka": statistics(2.0)}
    })
}

/// The same with Vicuna and one SigLIP tower: the files of openvla-v01-7b and of ECoT's Bridge
/// checkpoint differ in their statistics alone.
fn vicuna(datasets: &[&str]) -> Value {
    let mut config = openvla();
    config["llm_backbone_id"] = "vicuna-v15-7b".into();
    config["timm_model_ids"] = json!(["vit_so400m_patch14_siglip_224"]);
    config["timm_override_act_layers"] = json!([null]);
    config["use_fused_vision_backbone"] = false.into();
    config["image_sizes"] = json!([224]);
    config["image_resize_strategy"] = "letterbox".into();
    let datasets = datasets.iter().map(|name| ((*name).to_owned(), statistics(1.0)));
    config["norm_stats"] = Value::Object(datasets.collect());
    config
}

fn statistics(scale: f64) -> Value {
    json!({"action": {"q01": vec![-scale; 7], "q99": vec![scale; 7], "mask": [true, true, true, true, true, true, false]}})
}

/// The configuration of a folder with this config.json and other files.
fn read(config: &Value, files: &[(&str, String)], options: &LoadOptions) -> Result<Config> {
    let directory = tempfile::tempdir()?;
    std::fs::write(directory.path().join("config.json"), config.to_string())?;
    for (name, text) in files {
        std::fs::write(directory.path().join(name), text)?;
    }
    Config::load(directory.path(), options)
}

fn reason(config: Result<Config>) -> String {
    format!("{:#}", config.expect_err("it is refused"))
}

fn key(name: &str) -> LoadOptions {
    LoadOptions { unnorm_key: Some(name.to_owned()), ..LoadOptions::default() }
}

#[test]
fn the_included_policy_keeps_the_identity_that_verifiers_name() -> Result<()> {
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/bridge-small");
    let parser = crate::CompletionParser::load(&model, &LoadOptions::default())?;
    let expected = "477a03016de020ee3db3ef87322d6d2b6e3e550e4922a775d84575189884dd7d";
    assert_eq!(parser.digest(), expected);
    Ok(())
}

#[test]
fn one_of_several_datasets_is_chosen_by_name() -> Result<()> {
    let config = openvla();
    let refused = reason(read(&config, &[], &LoadOptions::default()));
    let expected = "unnorm_key: expected one of [\"bridge_orig\", \"kuka\"] (norm_stats of config.json), got none";
    assert!(refused.contains(expected), "{refused}");
    assert!(refused.ends_with("such as --unnorm-key bridge_orig"), "{refused}");
    assert_eq!(read(&config, &[], &key("kuka"))?.action_scale.q99[0], 2.0);
    assert_eq!(read(&config, &[], &key("bridge_orig"))?.action_scale.q99[0], 1.0);
    let refused = reason(read(&config, &[], &key("bridge")));
    assert!(refused.contains("got \"bridge\"; choose"), "{refused}");
    // A checkpoint with one dataset does not take any name either.
    let one = vicuna(&["bridge_orig"]);
    assert!(reason(read(&one, &[], &key("kuka"))).contains("expected one of [\"bridge_orig\"]"));
    assert!(read(&one, &[], &key("bridge_orig")).is_ok());
    Ok(())
}

#[test]
fn statistics_beside_the_configuration_are_preferred() -> Result<()> {
    let own = json!({"libero_spatial": statistics(3.0)}).to_string();
    let files = [("dataset_statistics.json", own)];
    let scale = read(&openvla(), &files, &LoadOptions::default())?.action_scale;
    assert_eq!(scale.q99[0], 3.0, "the only one of that file");
    let refused = reason(read(&openvla(), &files, &key("bridge_orig")));
    let expected =
        "expected one of [\"libero_spatial\"] (dataset_statistics.json), got \"bridge_orig\"";
    assert!(refused.contains(expected), "{refused}");
    let broken = [("dataset_statistics.json", "[".to_owned())];
    let refused = reason(read(&openvla(), &broken, &LoadOptions::default()));
    assert!(refused.contains("cannot use dataset_statistics.json"), "{refused}");
    Ok(())
}

#[test]
fn a_missing_mask_is_all_true_and_an_unused_dataset_spoils_nothing() -> Result<()> {
    let mut config = openvla();
    let mask = config["norm_stats"]["bridge_orig"]["action"].as_object_mut();
    mask.expect("statistics").remove("mask");
    config["norm_stats"]["kuka"]["action"]["q01"] = json!(vec![0.0; 14]);
    config["norm_stats"]["droid"] = json!("none");
    assert_eq!(read(&config, &[], &key("bridge_orig"))?.action_scale.mask, [true; 7]);
    let refused = reason(read(&config, &[], &key("kuka")));
    let expected = "statistics of kuka in norm_stats of config.json: q01: expected 7 numbers \
        (translation, rotation, gripper), got 14";
    assert!(refused.contains(expected), "{refused}");
    assert!(reason(read(&config, &[], &key("droid"))).contains("expected a field action"));
    Ok(())
}

#[test]
fn published_checkpoints_are_asked_as_they_were_trained() -> Result<()> {
    let check = |config: &Value, options: &LoadOptions, reasoning: bool, ending: &str| {
        let config = read(config, &[], options).expect(ending);
        assert_eq!(config.reasoning, reasoning, "{ending}");
        assert!(config.prompt_template.ends_with(ending), "{:?}", config.prompt_template);
        let limit = if reasoning { 1024 } else { 8 };
        assert_eq!((config.completion_tokens_max, config.partial_reasoning), (limit, reasoning));
    };
    let mode = |reasoning| LoadOptions { reasoning, ..LoadOptions::default() };
    check(&openvla(), &key("kuka"), false, "{instruction}?\nOut:");
    let on = LoadOptions { reasoning: ReasoningMode::On, ..key("kuka") };
    check(&openvla(), &on, true, "{instruction}?\nOut: TASK:");
    let mut oxe = openvla();
    oxe["norm_stats"] = json!({"bridge_reasoning": statistics(1.0)});
    check(&oxe, &mode(ReasoningMode::Auto), true, "\nOut: TASK:");
    let ecot = vicuna(&["bridge_orig"]);
    check(&ecot, &mode(ReasoningMode::Auto), true, " ASSISTANT: TASK:");
    check(&ecot, &mode(ReasoningMode::Off), false, " ASSISTANT:");
    check(&vicuna(&["bridge_orig", "kuka"]), &key("bridge_orig"), false, " ASSISTANT:");
    let mut says = vicuna(&["mine"]);
    says["reasoning"] = true.into();
    check(&says, &mode(ReasoningMode::Auto), true, " ASSISTANT: TASK:");
    let prompt = Some("Do {instruction}. TASK:".to_owned());
    let prompt = LoadOptions { prompt, ..LoadOptions::default() };
    check(&vicuna(&["mine"]), &prompt, true, "Do {instruction}. TASK:");
    Ok(())
}

#[test]
fn what_is_neither_ecots_nor_openvlas_is_not_guessed() {
    for (config, files) in [
        (vicuna(&["mine"]), vec![]),
        // A fine-tune of either.
        (
            vicuna(&["bridge_orig"]),
            vec![("dataset_statistics.json", json!({"a": statistics(1.0)}).to_string())],
        ),
    ] {
        let refused = reason(read(&config, &files, &LoadOptions::default()));
        for words in ["--reasoning on", "--reasoning off", "neither ECoT's"] {
            assert!(refused.contains(words), "{refused}");
        }
    }
    let prompt = Some("no place for it".to_owned());
    let refused = read(&openvla(), &[], &LoadOptions { prompt, ..key("kuka") });
    assert!(reason(refused).contains("prompt_template: expected {instruction} once"));
}

#[test]
fn options_are_part_of_the_identity() -> Result<()> {
    let expected = identity(tiny("tiny", Backend::Kernels))?;
    let none = LoadOptions::default();
    assert_eq!(identity(load_with("tiny", &none))?, expected);
    assert_eq!(identity(load_with("tiny", &key("rever_bridge")))?, expected, "the only one anyway");
    let options = [
        LoadOptions { reasoning: ReasoningMode::Off, ..none.clone() },
        LoadOptions { prompt: Some("{instruction}".to_owned()), ..none.clone() },
        LoadOptions { max_new_tokens: Some(17), ..none.clone() },
        LoadOptions { center_crop: true, ..none },
    ];
    let mut identities = vec![expected];
    for options in &options {
        identities.push(identity(load_with("tiny", options))?);
        // As they are in the header of a run.
        let text = serde_json::to_string(options)?;
        assert_eq!(&serde_json::from_str::<LoadOptions>(&text)?, options);
    }
    identities.sort();
    identities.dedup();
    assert_eq!(identities.len(), 1 + options.len());
    assert_eq!(serde_json::to_string(&LoadOptions::default())?, "{}");
    Ok(())
}

#[test]
fn a_centre_crop_changes_what_the_network_sees_and_nothing_else() -> Result<()> {
    let plain = tiny("tiny", Backend::Kernels)?;
    let cropped = load_with("tiny", &LoadOptions { center_crop: true, ..LoadOptions::default() })?;
    let pixels: Vec<u8> = (0..32 * 32 * 3).map(|index| (index * 7 % 251) as u8).collect();
    let image = Image { height: 32, width: 32, pixels: pixels.into() };
    let seen = crate::network::center_crop::center_crop(&image);
    let ids = plain.parser.prompter.ids("put the spoon on the towel")?;
    let logits = |policy: &Vla, image: &Image| -> Result<Tensor> {
        let outputs = policy.activations(image, &ids)?;
        Ok(outputs.last().expect("logits").1.clone())
    };
    let got = logits(&cropped, &image)?;
    assert_eq!(largest_difference(&got, &logits(&plain, &seen)?)?, 0.0);
    assert!(largest_difference(&got, &logits(&plain, &image)?)? > 0.0);
    Ok(())
}

#[test]
fn left_over_rotary_positions_are_ignored() -> Result<()> {
    let expected = identity(tiny("tiny", Backend::Kernels))?;
    let policy = load_changed(
        "tiny",
        |tensors| {
            let positions = Tensor::new(&[1_f32, 0.1], &Device::Cpu)?;
            let name = "language_model.model.layers.0.self_attn.rotary_emb.inv_freq";
            tensors.insert(name.to_owned(), positions);
            Ok(())
        },
        |_| {},
    );
    assert_eq!(identity(policy)?, expected);
    Ok(())
}

#[test]
fn quantised_weights_are_refused_in_words() {
    let words = "expected weights of 16 or 32 bits, got quantised ones";
    let policy = load_changed(
        "tiny",
        |tensors| {
            let name = "language_model.model.layers.0.mlp.up_proj.weight.SCB";
            tensors.insert(name.to_owned(), Tensor::new(&[1_f32], &Device::Cpu)?);
            Ok(())
        },
        |_| {},
    );
    assert!(refusal(policy).contains(words));
    let told = |config: &mut Value| {
        config["quantization_config"] =
            json!({"quant_method": "bitsandbytes", "load_in_4bit": true});
    };
    let refused = refusal(load_changed("tiny", |_| Ok(()), told));
    assert!(refused.contains("expected weights of 16 or 32 bits, got bitsandbytes"), "{refused}");
}

#[test]
fn an_irregular_chain_of_thought_costs_no_action() -> Result<()> {
    let strict = tiny("tiny", Backend::Kernels)?;
    let partly = |config: &mut Value| config["reasoning_strict"] = false.into();
    let lenient = load_changed("tiny", |_| Ok(()), partly)?;
    assert_ne!(strict.parser().digest(), lenient.parser().digest(), "they act differently");
    let golden = Golden::load(&fixtures().join("tiny/activations.safetensors"))?;
    let mut good = golden.ids("forced")?;
    assert_eq!(good.pop(), Some(2), "the golden completion ends with </s>");
    let whole = lenient.parser().parse(&good).expect("it is well formed");
    assert_eq!(Ok(&whole), strict.parser().parse(&good).as_ref());
    assert!(whole.reasoning.unread.is_empty());
    // Only the tokens of the action, as after a dropped chain of thought.
    let action = &good[good.len() - 7..];
    assert!(strict.parser().parse(action).is_err());
    let parsed = lenient.parser().parse(action).expect("the action is there");
    assert_eq!((&parsed.actions, &parsed.action_tokens), (&whole.actions, &whole.action_tokens));
    assert_eq!(parsed.reasoning.unread.len(), decision::TAGS.len());
    // Without an action there is nothing to execute.
    let error = lenient.parser().parse(&good[..good.len() - 3]).expect_err("four tokens");
    assert_eq!(error.to_string(), "expected 7 action tokens, got 4");
    Ok(())
}
