//! Every layer's output equals PyTorch's, and decoding token by token equals processing the whole
//! sequence.

use anyhow::Result;

use super::*;
use crate::network::decoder::Wanted;
use crate::network::forward::Context;
use crate::network::trace::Trace;

/// Maximum difference from PyTorch's float32 results in any element of any layer.
const TOLERANCE: f32 = 1e-4;

#[test]
fn every_layer_equals_pytorch() -> Result<()> {
    for name in TINY {
        for backend in [Backend::Kernels, Backend::Tensors(DType::F32)] {
            let policy = tiny(name, backend)?;
            let golden = Golden::load(&fixtures().join(name).join("activations.safetensors"))?;
            let ids = [golden.ids("prompt")?, golden.ids("forced")?].concat();
            let outputs = policy.activations(&golden.image("image")?, &ids)?;
            let inputs = ["image", "prompt", "forced", "greedy"];
            let mut expected: Vec<&str> = golden.0.keys().map(String::as_str).collect();
            expected.retain(|name| !inputs.contains(name));
            for layer in &expected {
                let output = outputs.iter().find(|(name, _)| name == layer);
                let (_, output) = output.with_context(|| format!("{name}: no output {layer}"))?;
                let difference = largest_difference(output, golden.tensor(layer)?)?;
                println!("{name} {backend:?} {layer}: {difference:.1e}");
                assert!(difference < TOLERANCE, "{name} {backend:?} {layer}: {difference}");
            }
            assert_eq!(outputs.len(), expected.len(), "{name}: an output without a golden value");
        }
    }
    Ok(())
}

#[test]
fn greedy_tokens_equal_pytorch() -> Result<()> {
    for name in TINY {
        for backend in [Backend::Kernels, Backend::Tensors(DType::F32)] {
            let policy = tiny(name, backend)?;
            let golden = Golden::load(&fixtures().join(name).join("activations.safetensors"))?;
            let (image, prompt) = (golden.image("image")?, golden.ids("prompt")?);
            let expected = golden.ids("greedy")?;
            let (tokens, _, _) = greedy(&policy, &image, &prompt, expected.len())?;
            assert_eq!(tokens, expected, "{name} {backend:?}");
        }
    }
    Ok(())
}

#[test]
fn steps_onto_a_shared_prefix_equal_the_whole_sequence() -> Result<()> {
    for name in TINY {
        for backend in [Backend::Kernels, Backend::Tensors(DType::F32)] {
            let policy = tiny(name, backend)?;
            let golden = Golden::load(&fixtures().join(name).join("activations.safetensors"))?;
            let image = golden.image("image")?;
            let prompts = [golden.ids("prompt")?, policy.parser.prompter.ids("stay")?];
            let forced = golden.ids("forced")?;
            // Two rows continue the first session, one the second; the middle row ends early.
            let rows = [(0, forced.clone()), (0, forced[5..].to_vec()), (1, forced[2..].to_vec())];
            let stepped = step_rows(&policy, &image, &prompts, &rows, forced.len() - 5)?;
            for ((session, ids), hidden) in rows.iter().zip(stepped) {
                let ids = [&prompts[*session][..], &ids[..hidden.dim(0)?]].concat();
                let contexts = [Context { image: &image, ids: &ids }];
                let (_, all) = policy.network.prefill(&contexts, Wanted::All, &mut Trace::off())?;
                let count = hidden.dim(0)?;
                let expected = all.narrow(0, all.dim(0)? - count, count)?;
                let difference = largest_difference(&hidden, &expected)?;
                assert!(difference < 1e-5, "{name} {backend:?}: {difference}");
                if backend == Backend::Kernels {
                    assert_eq!(difference, 0.0, "{name}: the kernels' sums have a fixed order");
                }
            }
        }
    }
    Ok(())
}

#[test]
fn the_shipped_model_equals_pytorch_on_recorded_observations() -> Result<()> {
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/bridge-small");
    let policy = Vla::load(&model, DeviceName::Cpu, &LoadOptions::default())?;
    let golden = Golden::load(&fixtures().join("bridge-small.safetensors"))?;
    for index in 0..8 {
        let name = |part: &str| format!("{index}.{part}");
        let (image, prompt) = (golden.image(&name("image"))?, golden.ids(&name("prompt"))?);
        let expected = golden.ids(&name("greedy"))?;
        let (tokens, hidden, logits) = greedy(&policy, &image, &prompt, expected.len())?;
        assert_eq!(tokens, expected, "observation {index}");
        for (part, got) in [("hidden", &hidden), ("logits", &logits)] {
            let difference = largest_difference(got, golden.tensor(&name(part))?)?;
            println!("observation {index} {part}: {difference:.1e}");
            assert!(difference < TOLERANCE, "observation {index} {part}: {difference}");
        }
        // A whole proposal gives the same tokens, and they are well-formed.
        let instruction = policy.parser().text(&prompt[2..3]);
        let request = decision::ProposalRequest {
            image: &image,
            state: &[],
            instruction: &instruction,
            candidates: 1,
            temperature: 0.0,
            seed: 0,
            episode: None,
        };
        let candidate = policy.propose_now(&[request])?.remove(0).candidates.remove(0);
        assert_eq!(candidate.tokens, expected[..expected.len() - 1], "observation {index}");
        assert!(candidate.parsed.is_ok(), "observation {index}: {:?}", candidate.parsed);
    }
    Ok(())
}

/// Hidden states of each row when the rows process their tokens one at a time.
fn step_rows(
    policy: &Vla,
    image: &Image,
    prompts: &[Vec<u32>],
    rows: &[(usize, Vec<u32>)],
    middle_ends_at: usize,
) -> Result<Vec<Tensor>> {
    let contexts: Vec<Context<'_>> = prompts.iter().map(|ids| Context { image, ids }).collect();
    let (prefix, _) = policy.network.prefill(&contexts, Wanted::Last, &mut Trace::off())?;
    let decoder = &policy.network.decoder;
    let mut tail = decoder.tails(rows.iter().map(|(session, _)| *session).collect(), 4);
    let mut active = vec![0, 1, 2];
    let mut hidden: Vec<Vec<Tensor>> = vec![Vec::new(); rows.len()];
    let steps = rows.iter().map(|(_, ids)| ids.len()).min().unwrap_or(0);
    for step in 0..steps {
        if step == middle_ends_at / 2 {
            tail.fork(&[0, 2])?;
            active = vec![0, 2];
        }
        let ids: Vec<u32> = active.iter().map(|&row: &usize| rows[row].1[step]).collect();
        let output = decoder.step(&ids, &prefix, &mut tail)?;
        for (index, &row) in active.iter().enumerate() {
            hidden[row].push(output.narrow(0, index, 1)?);
        }
    }
    hidden.iter().map(|states| Ok(Tensor::cat(states, 0)?)).collect()
}

/// Greedy tokens with the hidden state and logits that selected each, computed like PyTorch's.
fn greedy(
    policy: &Vla,
    image: &Image,
    prompt: &[u32],
    count: usize,
) -> Result<(Vec<u32>, Tensor, Tensor)> {
    let contexts = [Context { image, ids: prompt }];
    let (prefix, last) = policy.network.prefill(&contexts, Wanted::Last, &mut Trace::off())?;
    let decoder = &policy.network.decoder;
    let mut tail = decoder.tails(vec![0], 0);
    let (mut tokens, mut states, mut rows) = (Vec::new(), vec![last], Vec::new());
    while tokens.len() < count {
        let state = &states[states.len() - 1];
        let logits = decoder.logits(state)?;
        let token = logits.argmax(1)?.to_vec1::<u32>()?[0];
        rows.push(logits);
        tokens.push(token);
        if tokens.len() < count {
            let next = decoder.step(&[token], &prefix, &mut tail)?;
            states.push(next);
        }
    }
    Ok((tokens, Tensor::cat(&states, 0)?, Tensor::cat(&rows, 0)?))
}
