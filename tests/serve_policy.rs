//! The agent as a policy server, driven by its peers' own programs: `vla-eval run` and openpi's
//! client.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use decision::{
    ActionSpace, Decider, DecisionRequest, EpisodeContext, Image, Observation, Policy, Scorer,
    Setting, Strategy, sampling_seed,
};
use safetensors::SafeTensors;
use serde_json::{Value, json};
use verifier::Verifier;
use vla::{DeviceName, LoadOptions, Vla};

use crate::evaluation::Evaluation;
use crate::harness::{ReadyProgram, entries_below, peers, repository, rever, run, succeed, text};

const SEED: u64 = 3;
const CANDIDATES: u32 = 5;
// In the order of tasks.toml, which vla-eval numbers them in.
const TASKS: [&str; 2] = ["widowx_spoon_on_towel/distractors", "widowx_carrot_on_plate"];
const EPISODES: u32 = 2;
/// Rows and columns of the included policy's images.
const SIDE: usize = 128;

/// A running `rever serve-policy`.
fn served(arguments: &[&str]) -> ReadyProgram {
    let mut command = rever();
    command.args(["serve-policy", "--listen", "127.0.0.1:0", "--seed", &SEED.to_string()]);
    command.args(arguments);
    ReadyProgram::start(command)
}

#[test]
fn vla_eval_with_the_served_agent_equals_an_evaluation_step_by_step() {
    let folder = tempfile::tempdir().expect("a folder");
    let arguments = [
        "--strategies=verifier".to_owned(),
        format!("--candidates={CANDIDATES}"),
        format!("--episodes={EPISODES}"),
        "--layouts=grid".to_owned(),
        format!("--tasks={}", TASKS.join(",")),
        format!("--seed={SEED}"),
    ];
    let evaluation = Evaluation::new(folder.path(), &arguments.each_ref().map(String::as_str));
    evaluation.finish();
    let server = served(&[]);
    let results = folder.path().join("vla-eval");
    let configuration = json!({
        "server": { "url": server.name, "timeout": 300.0 },
        "output_dir": results,
        "benchmarks": [{
            "benchmark": "rever_env.vla_eval:ReverBenchmark",
            "episodes_per_task": EPISODES,
            "params": { "tasks": TASKS, "layouts": "grid", "seed": SEED },
        }],
    });
    // JSON is YAML.
    let file = folder.path().join("evaluation.yaml");
    std::fs::write(&file, configuration.to_string()).expect("a file");
    let mut vla_eval = peers().command();
    vla_eval.args(["-m", "vla_eval.cli.main", "run", "--no-docker", "--config"]).arg(&file);
    let output = run(vla_eval.current_dir(folder.path()));
    assert!(output.status.success(), "{}", text(&output));

    let records = evaluation.records();
    assert_eq!(records.len(), TASKS.len() * EPISODES as usize);
    for record in records.values() {
        let identity = &record.identity;
        let task = match &*identity.variant {
            "default" => identity.task.clone(),
            variant => format!("{}/{variant}", identity.task),
        };
        let index = TASKS.iter().position(|known| *known == task).expect("one of the tasks");
        let steps = steps_of(&results, index, identity.episode);
        assert_eq!(steps.len(), record.steps.len(), "{}", identity.id());
        for (step, (theirs, ours)) in steps.iter().zip(&record.steps).enumerate() {
            let action = theirs["action"].as_array().expect("an action").iter();
            let action: Vec<f32> =
                action.map(|number| number.as_f64().expect("a number") as f32).collect();
            assert_eq!(action, ours.action, "{} step {step}", identity.id());
            assert_eq!(theirs["success"], ours.statistics.is_success, "{} {step}", identity.id());
        }
    }
}

/// The steps that vla-eval recorded of one episode.
fn steps_of(results: &Path, task: usize, episode: u32) -> Vec<Value> {
    let name = format!("task{task:04}_ep{episode:04}_");
    let is_it = |path: &PathBuf| {
        path.file_name().is_some_and(|file| file.to_string_lossy().starts_with(&name))
    };
    let path = entries_below(results).map(|(path, _)| path).find(is_it);
    let path = path.unwrap_or_else(|| panic!("no file {name}* in {}", results.display()));
    let text = std::fs::read_to_string(path).expect("a file");
    text.lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect()
}

#[test]
fn openpis_client_gets_the_actions_of_the_decider_bit_by_bit_and_needs_the_key() {
    let folder = tempfile::tempdir().expect("a folder");
    let key = "a-key-for-this-test-alone";
    let key_file = folder.path().join("key");
    std::fs::write(&key_file, key).expect("a file");
    let server = served(&["--key-file", key_file.to_str().expect("a path in UTF-8")]);
    let recorded = recorded();
    let paths: Vec<PathBuf> =
        (0..recorded.len()).map(|index| folder.path().join(format!("{index}.rgb"))).collect();
    for (path, (image, _)) in paths.iter().zip(&recorded) {
        std::fs::write(path, &image.pixels).expect("a file");
    }
    // Three clients at once; the third leaves the name of its episode to the server.
    let episode = |name: Option<&str>, first: usize| {
        let images = &paths[first..first + 2];
        json!({ "name": name, "images": images, "prompt": recorded[first].1, "state": STATE })
    };
    let names = [Some("widowx_carrot_on_plate/default/0"), Some("another/default/1"), None];
    let episodes: Vec<Value> =
        names.iter().zip([0, 2, 4]).map(|(name, first)| episode(*name, first)).collect();
    let plan = |key: Option<&str>| json!({ "address": server.name, "key": key, "side": SIDE, "episodes": episodes });
    let mut client = client(folder.path(), &plan(Some(key)));
    let said = succeed(&mut client);
    let replies: Vec<Vec<Value>> = serde_json::from_str(said.trim()).expect("JSON");

    let expected = tokio::runtime::Runtime::new().expect("a runtime").block_on(async {
        let decider = InProcess::load();
        let mut expected = Vec::new();
        for (name, first) in names.iter().zip([0, 2, 4]) {
            let prompt = &recorded[first].1;
            let unnamed = format!("{prompt}/default/0");
            expected.push(
                decider.play(name.unwrap_or(&unnamed), prompt, &recorded[first..first + 2]).await,
            );
        }
        expected
    });
    let got = replies.iter().map(|replies| {
        let actions = replies.iter().map(|reply| {
            (reply["actions"].as_str().expect("text").to_owned(), reply["chosen"].as_u64())
        });
        actions.collect::<Vec<_>>()
    });
    assert_eq!(got.collect::<Vec<_>>(), expected);

    for wrong in [None, Some("another-key-of-many-letters")] {
        let output = run(&mut self::client(folder.path(), &plan(wrong)));
        assert!(!output.status.success() && text(&output).contains("401"), "{}", text(&output));
    }
}

const STATE: [f32; 8] = [0.3, 0.02, 0.12, 0.0, 0.0, 0.0, 0.0, 1.0];

fn client(folder: &Path, plan: &Value) -> Command {
    let file = folder.join("plan.json");
    std::fs::write(&file, plan.to_string()).expect("a file");
    let mut command = peers().command();
    command.arg(repository().join("tests/policy_client.py")).arg(file);
    command
}

/// The recorded images and instructions that benchmarks use.
fn recorded() -> Vec<(Image, String)> {
    let file = repository().join("agent/vla/tests/fixtures/bridge-small.safetensors");
    let bytes = std::fs::read(file).expect("the fixture");
    let tensors = SafeTensors::deserialize(&bytes).expect("tensors");
    let (_, header) = SafeTensors::read_metadata(&bytes).expect("a header");
    let words = header.metadata().clone().expect("metadata");
    let image = |index: usize| {
        let pixels = tensors.tensor(&format!("{index}.image")).expect("an image").data().to_vec();
        let image = Image { height: SIDE, width: SIDE, pixels: pixels.into() };
        (image, words[&format!("{index}.instruction")].clone())
    };
    (0..6).map(image).collect()
}

/// The included policy and its verifier in this process.
struct InProcess {
    decider: Decider,
    verifier: Arc<Verifier>,
}

impl InProcess {
    fn load() -> InProcess {
        let folder = repository().join("agent/models/bridge-small");
        let policy = Vla::load(&folder, DeviceName::Cpu, &LoadOptions::default());
        let policy = Arc::new(policy.expect("a policy")) as Arc<dyn Policy>;
        let file = folder.join("verifier.safetensors");
        let verifier = Verifier::load(&file, &policy.info().digest).expect("a verifier");
        InProcess { decider: Decider::new(policy), verifier: Arc::new(verifier) }
    }

    /// Bytes of the actions in hexadecimal, and the chosen candidate, of every decision.
    async fn play(
        &self,
        episode: &str,
        prompt: &str,
        images: &[(Image, String)],
    ) -> Vec<(String, Option<u64>)> {
        let setting = Setting::new(Strategy::Verifier, CANDIDATES, 1.0);
        let scorer = Arc::clone(&self.verifier) as Arc<dyn Scorer>;
        let seed = sampling_seed(episode, SEED);
        let mut context = EpisodeContext::new(setting, seed, prompt, Some(scorer), &[]);
        let space: &ActionSpace = &self.decider.policy().info().action_space;
        assert_eq!(space.length(), 7);
        let mut played = Vec::new();
        for (image, _) in images {
            let observation = Observation {
                image: image.clone(),
                state: STATE.to_vec(),
                instruction: prompt.to_owned(),
                expert_action: None,
            };
            let request = DecisionRequest { observation: &observation, context: &mut context };
            let decision = self.decider.decide(vec![request]).await.remove(0).expect("a decision");
            let numbers = decision.actions.actions().iter().flatten();
            let bytes = numbers.flat_map(|number| number.to_le_bytes());
            let hexadecimal = bytes.map(|byte| format!("{byte:02x}")).collect();
            played.push((hexadecimal, decision.chosen.map(|index| index as u64)));
        }
        played
    }
}
