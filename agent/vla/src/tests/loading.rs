//! Loading: tensors are read once and in turn, the digest is kept, other formats compute nearly the
//! same.

use std::cell::RefCell;
use std::path::Path;

use anyhow::Result;

use super::*;
use crate::CompletionParser;
use crate::checkpoint::config::Config;
use crate::checkpoint::digest_cache::DigestCache;
use crate::checkpoint::identity::{Fingerprint, used_tensors};
use crate::checkpoint::shards::Shards;
use crate::checkpoint::weights::{Loaded, Rest, Weights};
use crate::network::forward::Network;

/// Loads the network alone, with a digest, and returns what was reported and left.
fn load_network(directory: &Path) -> Result<(Vec<Loaded>, Rest)> {
    let config = Config::load(directory, &LoadOptions::default())?;
    let shards = Shards::open(directory)?;
    let hashing = Fingerprint::of(directory, &config)?.start(&shards, &config)?;
    let used = used_tensors(&shards, &config);
    let target =
        Target { device: Device::Cpu, backend: Backend::Kernels, format: WeightFormat::Exact };
    let reports = RefCell::new(Vec::new());
    let report = |loaded| reports.borrow_mut().push(loaded);
    let weights = Weights::new(&shards, &used, Some(hashing), target, &report);
    let (_, rest) = Network::load(weights, &config)?;
    Ok((reports.into_inner(), rest))
}

#[test]
fn every_tensor_is_read_once_and_reported() -> Result<()> {
    // Per tower of tiny-fused: an unused block of 12 weights (14 with layer scale), and the final
    // norm.
    for (name, dead_weights) in [("tiny", 0), ("tiny-fused", 14 + 12 + 2 * 2)] {
        let (reports, rest) = load_network(&fixtures().join(name))?;
        let digest = CompletionParser::load(&fixtures().join(name), &LoadOptions::default())?
            .digest()
            .to_owned();
        assert_eq!(rest, Rest { dead_weights, digest: Some(digest), bytes_read_again: 0 });
        assert!(reports.is_sorted_by(|one, next| one.bytes < next.bytes), "{name}: {reports:?}");
        let last = reports.last().expect("a report");
        assert_eq!(last.bytes, last.bytes_total, "{name}");
    }
    Ok(())
}

#[test]
fn a_file_that_was_cut_is_refused() -> Result<()> {
    let directory = copy()?;
    let weights = directory.path().join("model.safetensors");
    let length = std::fs::metadata(&weights)?.len();
    std::fs::OpenOptions::new().write(true).open(&weights)?.set_len(length - 1)?;
    let error = Vla::load(directory.path(), DeviceName::Cpu, &LoadOptions::default())
        .err()
        .expect("a refusal");
    let expected = format!("safetensors file: expected {length} bytes, got {}", length - 1);
    assert!(format!("{error:#}").ends_with(&expected), "{error:#}");
    Ok(())
}

/// A copy of tiny.
fn copy() -> Result<tempfile::TempDir> {
    let directory = tempfile::tempdir()?;
    for name in ["config.json", "tokenizer.json", "model.safetensors"] {
        std::fs::copy(fixtures().join("tiny").join(name), directory.path().join(name))?;
    }
    Ok(directory)
}

#[test]
fn a_kept_digest_counts_only_while_nothing_has_changed() -> Result<()> {
    let directory = copy()?;
    let folder = directory.path();
    let elsewhere = folder.join("elsewhere");
    let config = Config::load(folder, &LoadOptions::default())?;
    let fingerprint = Fingerprint::of(folder, &config)?;
    let other =
        Fingerprint::of(folder, &Config { prompt_template: "{instruction}".into(), ..config })?;

    let cache = DigestCache::open(folder, Some(&elsewhere))?;
    cache.keep(&fingerprint, "small");
    assert_eq!(cache.digest(&fingerprint), None, "small checkpoints are hashed each time");
    cache.clone().of_any_size().keep(&fingerprint, "fresh");
    assert_eq!(cache.digest(&fingerprint), None, "files changed a moment ago may change unnoticed");

    let cache = cache.of_any_size().settled_at_once();
    cache.keep(&fingerprint, "one");
    cache.keep(&other, "two");
    let read = || DigestCache::open(folder, Some(&elsewhere));
    assert_eq!(read()?.digest(&fingerprint), Some("one".to_owned()));
    assert_eq!(read()?.digest(&other), Some("two".to_owned()), "another configuration");
    assert!(!elsewhere.exists(), "the folder can be written");

    // The same bytes again: only the times differ.
    let weights = folder.join("model.safetensors");
    std::fs::write(&weights, std::fs::read(&weights)?)?;
    assert_eq!(read()?.digest(&fingerprint), None, "the weights were written again");
    let cache = read()?.of_any_size().settled_at_once();
    cache.keep(&fingerprint, "three");
    assert_eq!(read()?.digest(&fingerprint), Some("three".to_owned()));
    assert_eq!(read()?.digest(&other), None, "old entries are dropped with the old files");
    std::fs::write(&weights, b"shorter")?;
    cache.keep(&fingerprint, "four");
    assert_eq!(read()?.digest(&fingerprint), None, "changed while it was read");
    Ok(())
}

#[test]
fn a_digest_is_kept_elsewhere_where_the_folder_cannot_be_written() -> Result<()> {
    let directory = copy()?;
    let folder = directory.path();
    let elsewhere = folder.join("elsewhere");
    // Also root cannot write a file in place of a folder.
    std::fs::create_dir_all(folder.join(".rever-digest.json/occupied"))?;
    let config = Config::load(folder, &LoadOptions::default())?;
    let fingerprint = Fingerprint::of(folder, &config)?;
    let cache = DigestCache::open(folder, Some(&elsewhere))?.of_any_size().settled_at_once();
    cache.keep(&fingerprint, "one");
    assert_eq!(cache.digest(&fingerprint), Some("one".to_owned()));
    assert_eq!(elsewhere.read_dir()?.count(), 1);
    assert_eq!(DigestCache::open(folder, None)?.digest(&fingerprint), None);
    Ok(())
}

/// The logits of the golden sequence, and the greedy tokens after its prompt.
fn logits(name: &str, backend: Backend, format: WeightFormat) -> Result<(Tensor, Vec<u32>)> {
    let target = Target { device: Device::Cpu, backend, format };
    let policy = Vla::load_onto(
        &fixtures().join(name),
        &LoadOptions::default(),
        target,
        &Loading::default(),
    )?;
    let golden = Golden::load(&fixtures().join(name).join("activations.safetensors"))?;
    let (image, prompt) = (golden.image("image")?, golden.ids("prompt")?);
    let ids = [prompt.clone(), golden.ids("forced")?].concat();
    let (_, logits) = policy.activations(&image, &ids)?.pop().context("no logits")?;
    let request = decision::ProposalRequest {
        image: &image,
        state: &[],
        instruction: "put the spoon on the towel",
        candidates: 3,
        temperature: 0.0,
        seed: 0,
        episode: None,
    };
    let tokens = policy.propose_now(&[request])?.remove(0).candidates.remove(0).tokens;
    Ok((logits, tokens))
}

#[test]
fn sixteen_and_eight_bits_compute_nearly_the_same() -> Result<()> {
    for name in TINY {
        let (expected, tokens) = logits(name, Backend::Kernels, WeightFormat::Exact)?;
        let spread = expected.flatten_all()?.var(0)?.sqrt()?.to_scalar::<f32>()?;
        // On the CPU candle multiplies f16 but not bf16; a GPU uses bf16 through the same code.
        let halved = logits(name, Backend::Tensors(DType::F16), WeightFormat::Exact)?;
        let eight = logits(name, Backend::Kernels, WeightFormat::Eight)?;
        for (kind, (got, _), limit) in [("16", &halved, 0.05), ("8", &eight, 0.5)] {
            let difference = largest_difference(&expected, got)? / spread;
            println!("{name}: {kind} bits: {difference:.1e} of the logits' deviation");
            assert!(difference > 0.0 && difference < limit, "{name}: {kind} bits: {difference}");
        }
        assert_eq!(halved.1, tokens, "{name}");
    }
    Ok(())
}

#[test]
fn a_session_s_caches_have_a_known_size() -> Result<()> {
    let policy = tiny("tiny", Backend::Kernels)?;
    // Two layers, keys and values, 32 wide, 4 bytes: 512 bytes per position.
    let prompt = policy.parser.prompter.ids("")?.len() + 64;
    let prefix = (16 + prompt).next_multiple_of(8);
    let tail = (policy.tokens_max(prompt) + 1).next_multiple_of(64);
    assert_eq!(policy.cache_bytes(1)?, 512 * (prefix + tail));
    assert_eq!(policy.cache_bytes(5)?, 512 * (prefix + 5 * tail));
    let halved = tiny("tiny", Backend::Tensors(DType::F16))?;
    assert_eq!(2 * halved.cache_bytes(5)?, policy.cache_bytes(5)?);
    Ok(())
}
