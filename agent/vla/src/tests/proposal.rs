//! Proposals: batches, seeds, temperatures and refusals.

use anyhow::Result;
use candle_core::D;

use super::*;
use decision::{Candidate, Proposal, ProposalRequest, TAGS};

/// Parts of the confidence: the tags and the seven dimensions of an action.
const PARTS: usize = TAGS.len() + 7;

const INSTRUCTION: &str = "Put the spoon on the towel";

fn image(seed: u8, side: usize) -> Image {
    let byte = |index: usize| (index * 31 + index / 7 + usize::from(seed) * 57) as u8;
    Image { height: side, width: side, pixels: (0..side * side * 3).map(byte).collect() }
}

fn request(image: &Image, candidates: usize, temperature: f32, seed: u64) -> ProposalRequest<'_> {
    ProposalRequest {
        image,
        state: &[],
        instruction: INSTRUCTION,
        candidates,
        temperature,
        seed,
        episode: None,
    }
}

#[test]
fn a_request_does_not_depend_on_the_other_requests_of_the_batch() -> Result<()> {
    for name in TINY {
        let policy = tiny(name, Backend::Kernels)?;
        let side = policy.info().image_size.0;
        let images: Vec<Image> = (0..16).map(|index| image(index, side)).collect();
        let instructions = ["Put the spoon on the towel", "stay", "a much longer instruction"];
        let requests: Vec<ProposalRequest<'_>> = images
            .iter()
            .enumerate()
            .map(|(index, image)| ProposalRequest {
                state: &[],
                instruction: instructions[index % 3],
                ..request(image, 1 + index % 5, [1.0, 0.0, 0.7][index % 3], index as u64)
            })
            .collect();
        let together = policy.propose_now(&requests)?;
        for (request, expected) in requests.iter().zip(&together) {
            // Bitwise equal: tokens, log-probability, hidden state.
            assert_eq!(&policy.propose_now(&[*request])?, std::slice::from_ref(expected));
        }
        let mut reversed: Vec<ProposalRequest<'_>> = requests.clone();
        reversed.reverse();
        let mut proposals = policy.propose_now(&reversed)?;
        proposals.reverse();
        assert_eq!(proposals, together);
    }
    Ok(())
}

#[test]
fn parallel_calls_give_the_same_results_as_sequential_calls() -> Result<()> {
    let policy = tiny("tiny", Backend::Kernels)?;
    let images: Vec<Image> = (0..12).map(|seed| image(seed, policy.info().image_size.0)).collect();
    let requests: Vec<_> = images.iter().map(|image| request(image, 5, 1.0, 9)).collect();
    let calls: Vec<&[ProposalRequest<'_>]> = requests.chunks(4).collect();
    let alone: Vec<_> = calls.iter().map(|call| policy.propose_now(call)).collect::<Result<_>>()?;
    std::thread::scope(|scope| {
        let policy = &policy;
        let threads = calls.iter().map(|&call| {
            let again =
                move || (0..4).map(|_| policy.propose_now(call)).collect::<Result<Vec<_>>>();
            scope.spawn(again)
        });
        let threads: Vec<_> = threads.collect();
        for (thread, expected) in threads.into_iter().zip(&alone) {
            let proposals = thread.join().expect("no panic").expect("proposals");
            assert!(proposals.iter().all(|proposals| proposals == expected));
        }
    });
    Ok(())
}

#[test]
fn the_number_of_threads_does_not_change_the_result() -> Result<()> {
    let policy = tiny("tiny", Backend::Kernels)?;
    let image = image(3, policy.info().image_size.0);
    let requests = [request(&image, 8, 1.0, 5), request(&image, 3, 1.0, 6)];
    let propose = |threads: usize| -> Result<Vec<Proposal>> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        pool.install(|| policy.propose_now(&requests))
    };
    assert_eq!(propose(1)?, propose(4)?);
    Ok(())
}

#[test]
fn seeds_determine_the_result_and_each_candidate_has_its_own_stream() -> Result<()> {
    let policy = tiny("tiny", Backend::Kernels)?;
    let image = image(1, policy.info().image_size.0);
    let propose = |candidates, seed| -> Result<Vec<Candidate>> {
        Ok(policy.propose_now(&[request(&image, candidates, 1.0, seed)])?.remove(0).candidates)
    };
    let five = propose(5, 9)?;
    assert_eq!(five, propose(5, 9)?);
    assert_eq!(five[..1], propose(1, 9)?);
    assert_ne!(five[0].tokens, propose(1, 10)?[0].tokens);
    for (index, candidate) in five.iter().enumerate() {
        assert!(five[index + 1..].iter().all(|other| other.tokens != candidate.tokens));
    }
    Ok(())
}

#[test]
fn temperature_zero_ignores_seeds() -> Result<()> {
    let policy = tiny("tiny", Backend::Kernels)?;
    let image = image(1, policy.info().image_size.0);
    let a = policy.propose_now(&[request(&image, 2, 0.0, 1)])?.remove(0).candidates;
    let b = policy.propose_now(&[request(&image, 1, 0.0, 2)])?.remove(0).candidates;
    assert_eq!(a[0], a[1]);
    assert_eq!(a[0], b[0]);
    Ok(())
}

#[test]
fn both_backends_sample_the_same_tokens() -> Result<()> {
    for name in TINY {
        let propose = |backend| -> Result<Vec<Vec<u32>>> {
            let policy = tiny(name, backend)?;
            let image = image(2, policy.info().image_size.0);
            let proposal = policy.propose_now(&[request(&image, 6, 1.0, 4)])?.remove(0);
            Ok(proposal.candidates.into_iter().map(|candidate| candidate.tokens).collect())
        };
        assert_eq!(propose(Backend::Kernels)?, propose(Backend::Tensors(DType::F32))?, "{name}");
    }
    Ok(())
}

#[test]
fn first_tokens_follow_the_softmax_distribution() -> Result<()> {
    let mut policy = tiny("tiny", Backend::Kernels)?;
    policy.parser.config.completion_tokens_max = 1;
    let image = image(4, policy.info().image_size.0);
    let outputs = policy.activations(&image, &policy.parser.prompter.ids(INSTRUCTION)?)?;
    let logits = &outputs[outputs.len() - 1].1;
    let last =
        logits.narrow(0, logits.dim(0)? - 1, 1)?.narrow(1, 0, policy.parser.config.vocabulary)?;
    let draws = 4000;
    for temperature in [0.5f32, 1.0] {
        let scaled = (&last / f64::from(temperature))?;
        let log_sum = scaled.log_sum_exp(D::Minus1)?;
        let softmax: Vec<f32> =
            scaled.broadcast_sub(&log_sum.unsqueeze(1)?)?.exp()?.squeeze(0)?.to_vec1()?;
        let proposal = policy.propose_now(&[request(&image, draws, temperature, 11)])?.remove(0);
        let mut counts = vec![0u32; policy.parser.config.vocabulary];
        for candidate in &proposal.candidates {
            // A completion without tokens sampled the end at once.
            counts[candidate.tokens.first().map_or(2, |&token| token as usize)] += 1;
        }
        // Chi-squared over the tokens expected at least five times; all others count as one cell.
        let expected: Vec<f64> = softmax.iter().map(|&p| f64::from(p) * draws as f64).collect();
        let (mut statistic, mut cells, mut rest) = (0.0, 0u32, (0.0, 0.0));
        for (&count, &expected) in counts.iter().zip(&expected) {
            if expected >= 5.0 {
                statistic += (f64::from(count) - expected).powi(2) / expected;
                cells += 1;
            } else {
                rest = (rest.0 + f64::from(count), rest.1 + expected);
            }
        }
        statistic += (rest.0 - rest.1).powi(2) / f64::max(rest.1, 1.0);
        // The mean plus four standard deviations of a chi-squared distribution with this number of
        // cells.
        let limit = f64::from(cells) + 4.0 * (2.0 * f64::from(cells)).sqrt();
        assert!(cells > 10 && statistic < limit, "{statistic} over {cells} cells, limit {limit}");
    }
    Ok(())
}

#[test]
fn log_probabilities_are_those_of_temperature_one() -> Result<()> {
    let policy = tiny("tiny", Backend::Kernels)?;
    let image = image(5, policy.info().image_size.0);
    let prompt = policy.parser.prompter.ids(INSTRUCTION)?;
    for temperature in [0.0, 0.6, 1.0] {
        let proposal = policy.propose_now(&[request(&image, 3, temperature, 3)])?.remove(0);
        for candidate in proposal.candidates {
            let ids = [&prompt[..], &candidate.tokens].concat();
            let outputs = policy.activations(&image, &ids)?;
            let logits = &outputs[outputs.len() - 1].1;
            let count = candidate.tokens.len();
            let rows = logits.narrow(0, logits.dim(0)? - count - 1, count + 1)?;
            let rows = rows.narrow(1, 0, policy.parser.config.vocabulary)?;
            let log_sums: Vec<f32> = rows.log_sum_exp(D::Minus1)?.to_vec1()?;
            let rows: Vec<Vec<f32>> = rows.to_vec2()?;
            let likelihood = |row: usize, id: u32| rows[row][id as usize] - log_sums[row];
            let mut sum: f32 =
                candidate.tokens.iter().enumerate().map(|(row, &id)| likelihood(row, id)).sum();
            let ended = candidate.log_probability - sum;
            // A candidate that was cut has no end token in its sum.
            if ended.abs() > 1e-3 {
                sum += likelihood(count, 2);
            }
            let difference = (candidate.log_probability - sum).abs();
            assert!(difference < 1e-3, "{difference} of {sum} at temperature {temperature}");
        }
    }
    Ok(())
}

#[test]
fn confidence_is_the_sum_over_each_section_and_each_action_dimension() -> Result<()> {
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/bridge-small");
    for policy in [
        Vla::load(&shipped, DeviceName::Cpu, &LoadOptions::default())?,
        tiny("tiny", Backend::Kernels)?,
    ] {
        let image = image(6, policy.info().image_size.0);
        let proposal = policy.propose_now(&[request(&image, 8, 1.0, 4)])?.remove(0);
        for Candidate { tokens, log_probabilities, .. } in proposal.candidates {
            let (mut expected, mut actions) = (vec![0.0; PARTS], TAGS.len());
            for (index, log_probability) in log_probabilities.iter().enumerate() {
                let part = if policy.parser.bins.contains(tokens[index]) {
                    actions += 1;
                    (actions - 1).min(PARTS - 1)
                } else {
                    section(&policy.parser().text(&tokens[..=index]))
                };
                expected[part] += log_probability.max(-8.0);
            }
            assert_eq!(policy.parser().confidence(&tokens, &log_probabilities), expected);
        }
    }
    Ok(())
}

/// The tag of the section that contains the end of the text, by a direct search.
fn section(text: &str) -> usize {
    let ends = |at: usize, tag: &str| {
        let begins = at == 0 || text[..at].ends_with(char::is_whitespace);
        begins && text[at..].starts_with(tag)
    };
    let last =
        |tag: &&str| (0..text.len()).rev().find(|at| text.is_char_boundary(*at) && ends(*at, tag));
    let found = TAGS.iter().enumerate().filter_map(|(index, tag)| Some((last(tag)?, index)));
    found.max().map_or(0, |(_, index)| index)
}

#[test]
fn invalid_requests_are_refused_with_a_reason() -> Result<()> {
    let policy = tiny("tiny", Backend::Kernels)?;
    let check = |request: ProposalRequest<'_>, expected: &str| match policy.propose_now(&[request])
    {
        Err(error) => assert_eq!(error.to_string(), expected),
        Ok(_) => panic!("expected a refusal: {expected}"),
    };
    let (good, large) = (image(0, 32), image(0, 64));
    check(
        request(&large, 1, 1.0, 0),
        "image: expected 32 x 32 pixels, got 64 x 64; request images of that size from the server",
    );
    let short = Image { pixels: vec![0; 5].into(), ..good.clone() };
    check(request(&short, 1, 1.0, 0), "image: expected 3072 bytes, got 5");
    check(request(&good, 0, 1.0, 0), "candidates: expected at least 1, got 0");
    check(request(&good, 1, -1.0, 0), "temperature: expected 0 or more, got -1");
    check(request(&good, 1, f32::NAN, 0), "temperature: expected 0 or more, got NaN");
    assert!(policy.propose_now(&[])?.is_empty());
    Ok(())
}

#[test]
fn tokens_parse_strictly() -> Result<()> {
    let policy = tiny("tiny", Backend::Kernels)?;
    let golden = Golden::load(&fixtures().join("tiny/activations.safetensors"))?;
    let mut good = golden.ids("forced")?;
    assert_eq!(good.pop(), Some(2), "the golden completion ends with </s>");
    let parsed = policy.parser().parse(&good)?;
    assert_eq!(parsed.reasoning.subtask, "reach the spoon");
    assert_eq!(parsed.reasoning.visible_objects[1].bounding_box, [60, 62, 90, 98]);
    assert_eq!(parsed.reasoning.gripper_position, [[120, 84]]);
    // The digits 1, 64, 128, 129, 200, 255, 256 below a vocabulary of 960.
    assert_eq!(parsed.action_tokens, [959, 896, 832, 831, 760, 705, 704]);
    assert!((parsed.actions.first()[0] + 0.03 - 0.06 * 0.5 / 255.0).abs() < 1e-7);
    assert_eq!(parsed.actions.first()[6], 1.0);
    let check = |ids: &[u32], expected: &str| match policy.parser().parse(ids) {
        Err(malformed) => assert_eq!(malformed.to_string(), expected),
        Ok(_) => panic!("expected a refusal: {expected}"),
    };
    let length = good.len();
    check(&good[..length - 1], "expected 7 action tokens, got 6");
    check(&good[..length - 7], "expected 7 action tokens, got 0");
    check(&good[..length - 8], "expected ACTION:, got the end");
    check(&[], "expected TASK:, got the end");
    check(
        &[&good[..], &[700]].concat(),
        "expected the end after 7 action tokens, got \"<reserved47>\"",
    );
    check(&[&good[..], &[704]].concat(), "expected 7 action tokens, got 8");
    Ok(())
}
