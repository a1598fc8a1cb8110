//! A checkpoint that reads the candidates of other policies.

use std::path::Path;
use std::sync::Arc;

use anyhow::Result;
use async_trait::async_trait;
use decision::{
    ActionChunk, ActionSpace, Candidate, Malformed, Parsed, Policy, PolicyInfo, Proposal,
    ProposalRequest, Reasoning, Setting, Strategy, fit_image,
};

use super::{Backend, Golden, Image, LoadOptions, fixtures};
use crate::{BackbonePolicy, Vla};

const INSTRUCTION: &str = "put the spoon on the towel";

fn included() -> Result<Arc<Vla>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/bridge-small");
    let device = candle_core::Device::Cpu;
    Vla::load_on(&folder, &device, Backend::Kernels, &LoadOptions::default()).map(Arc::new)
}

fn camera() -> Result<Image> {
    Golden::load(&fixtures().join("bridge-small.safetensors"))?.image("0.image")
}

fn request(image: &Image, candidates: usize, temperature: f32) -> ProposalRequest<'_> {
    ProposalRequest {
        image,
        state: &[],
        instruction: INSTRUCTION,
        candidates,
        temperature,
        seed: 5,
        episode: None,
    }
}

/// A policy that proposes the same candidates in every decision.
struct Fixed {
    info: PolicyInfo,
    candidates: Vec<Candidate>,
}

impl Fixed {
    fn new(candidates: Vec<Candidate>, side: usize, length: usize) -> Arc<Fixed> {
        let action_space = ActionSpace { scale: vec![0.1; length], gripper: length.checked_sub(1) };
        let info = PolicyInfo {
            digest: "f00d".to_owned(),
            image_size: (side, side),
            action_space,
            hidden_size: None,
            parallel_calls: 64,
        };
        Arc::new(Fixed { info, candidates })
    }
}

#[async_trait]
impl Policy for Fixed {
    fn info(&self) -> &PolicyInfo {
        &self.info
    }

    async fn propose(&self, requests: &[ProposalRequest<'_>]) -> Result<Vec<Proposal>> {
        let proposal = || Proposal { candidates: self.candidates.clone() };
        Ok(requests.iter().map(|_| proposal()).collect())
    }

    fn check(&self, setting: &Setting) -> Result<()> {
        anyhow::ensure!(!setting.strategy.needs_verifier(), "expected no verifier");
        anyhow::ensure!(setting.candidates <= 5, "expected at most 5 candidates");
        Ok(())
    }
}

/// A candidate of a policy that exposes only its actions.
fn bare(actions: Vec<Vec<f32>>) -> Candidate {
    let actions = ActionChunk::new(actions).expect("finite");
    Candidate {
        tokens: Vec::new(),
        log_probability: 0.0,
        log_probabilities: Vec::new(),
        confidence: Vec::new(),
        hidden: Vec::new(),
        parsed: Ok(Parsed { reasoning: Reasoning::default(), action_tokens: Vec::new(), actions }),
    }
}

fn malformed() -> Candidate {
    Candidate { parsed: Err(Malformed::new("expected an action")), ..bare(vec![vec![0.0; 7]]) }
}

#[tokio::test]
async fn a_backbone_reads_its_own_greedy_action_as_it_wrote_it() -> Result<()> {
    let (backbone, image) = (included()?, camera()?);
    let own = backbone.propose_now(&[request(&image, 1, 0.0)])?.remove(0).candidates.remove(0);
    let own_parsed = own.parsed.clone().expect("well formed");
    let first = own_parsed.actions.first().to_vec();
    let mut second = first.clone();
    second[0] += 0.02;
    // The second action of a chunk is not read.
    let chunk = vec![first, vec![9.0; 7]];
    let candidates = vec![bare(chunk.clone()), malformed(), bare(vec![second])];
    let side = backbone.info().image_size.0;
    let policy = BackbonePolicy::new(Fixed::new(candidates, side, 7), Arc::clone(&backbone))?;
    let read = policy.propose(&[request(&image, 3, 1.0)]).await?.remove(0).candidates;
    // Bit for bit: tokens, log-probabilities, confidence and hidden state.
    let parsed = read[0].parsed.clone().expect("well formed");
    assert_eq!(Candidate { parsed: own.parsed.clone(), ..read[0].clone() }, own);
    assert_eq!((&parsed.reasoning, parsed.actions.actions()), (&own_parsed.reasoning, &*chunk));
    assert!(parsed.action_tokens.is_empty(), "the policy has no tokens");
    assert_eq!(read[1], malformed());
    let other = &read[2];
    assert_eq!(other.parsed.as_ref().expect("well formed").reasoning, own_parsed.reasoning);
    assert_ne!((&other.tokens, &other.hidden), (&own.tokens, &own.hidden));
    assert!(other.log_probability < own.log_probability, "it would have chosen the first one");
    Ok(())
}

#[tokio::test]
async fn decisions_of_a_batch_are_read_as_each_alone_and_images_are_resized() -> Result<()> {
    let (backbone, image) = (included()?, camera()?);
    let large = fit_image(image, (224, 224))?;
    let black = Image { height: 224, width: 224, pixels: vec![0; 224 * 224 * 3].into() };
    let actions = [0.01, -0.02, 0.03].map(|x| bare(vec![vec![x, 0.0, x, 0.0, 0.0, 0.1, 1.0]]));
    let policy = BackbonePolicy::new(Fixed::new(actions.to_vec(), 224, 7), Arc::clone(&backbone))?;
    let requests = [request(&large, 3, 1.0), request(&black, 3, 1.0)];
    let together = policy.propose(&requests).await?;
    for (one, expected) in requests.iter().zip(&together) {
        assert_eq!(&policy.propose(&[*one]).await?[0], expected);
    }
    assert_eq!(together[0].candidates[0].hidden.len(), policy.info().hidden_size.expect("a size"));
    // A decision without any action is not read.
    let none = BackbonePolicy::new(Fixed::new(vec![malformed()], 224, 7), backbone)?;
    assert_eq!(none.propose(&requests).await?[1].candidates, [malformed()]);
    Ok(())
}

#[test]
fn what_a_backbone_cannot_read_is_refused_and_what_it_adds_is_part_of_the_identity() -> Result<()> {
    let backbone = included()?;
    let refusal = |policy: Arc<Fixed>| {
        let read = BackbonePolicy::new(policy, Arc::clone(&backbone));
        read.map(drop).expect_err("refused").to_string()
    };
    let two = refusal(Fixed::new(Vec::new(), 128, 2));
    assert!(two.contains("7 numbers and the gripper last, got 2 numbers"), "{two}");
    let blind = refusal(Fixed::new(Vec::new(), 0, 7));
    assert!(blind.contains("expected a policy that sees images"), "{blind}");
    let policy = BackbonePolicy::new(Fixed::new(Vec::new(), 128, 7), Arc::clone(&backbone))?;
    let digest = &policy.info().digest;
    assert!(digest.len() == 64 && *digest != backbone.info().digest);
    // The policy alone could not use a verifier. The maximum number of candidates is the policy's.
    policy.check(&Setting::new(Strategy::Verifier, 5, 1.0))?;
    let many = policy.check(&Setting::new(Strategy::Verifier, 6, 1.0)).expect_err("too many");
    assert_eq!(many.to_string(), "expected at most 5 candidates");
    Ok(())
}

#[tokio::test]
async fn a_backbone_that_writes_no_action_makes_all_candidates_equal() -> Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/bridge-small");
    let options = LoadOptions { max_new_tokens: Some(5), ..LoadOptions::default() };
    let device = candle_core::Device::Cpu;
    let backbone = Arc::new(Vla::load_on(&folder, &device, Backend::Kernels, &options)?);
    let sent = |x: f32| Candidate {
        tokens: vec![1, 2],
        hidden: vec![x; 3],
        ..bare(vec![vec![x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    };
    let policy = BackbonePolicy::new(Fixed::new(vec![sent(0.01), sent(0.02)], 128, 7), backbone)?;
    let read = policy.propose(&[request(&camera()?, 2, 1.0)]).await?.remove(0).candidates;
    for (candidate, x) in read.iter().zip([0.01, 0.02]) {
        let parsed = candidate.parsed.as_ref().expect("the policy's action stays");
        assert_eq!(parsed.actions.first()[0], x);
        assert_eq!((&candidate.hidden, &candidate.confidence), (&vec![0.0; 256], &vec![0.0; 16]));
        assert!(candidate.tokens.is_empty(), "nothing was read");
    }
    Ok(())
}
