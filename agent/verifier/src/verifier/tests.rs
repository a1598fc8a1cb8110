//! Verifiers with arbitrary weights, the shipped verifier, and broken files.

use decision::{
    ActionChunk, ActionSpace, Image, Malformed, Parsed, Reasoning, Stage, TrackedObjects,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::{
    FeatureLayout, Layer, Metrics, RankingEvidence, ReRankingGain, ScoredSamples, Standardisation,
    TERMS, TargetMap, TargetModel, TrainingData, TrainingOptions,
};

const BRIDGE: FeatureLayout = FeatureLayout { action_length: 7 };

fn space() -> ActionSpace {
    ActionSpace { scale: vec![1.0; 7], gripper: None }
}

fn network(seed: u64) -> Network {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut values =
        |count: usize| -> Vec<f32> { (0..count).map(|_| random.random_range(-1.0..1.0)).collect() };
    let layers = [
        Layer::new(values(20), values(4)),
        Layer::new(values(12), values(3)),
        Layer::new(values(3), values(1)),
    ];
    let standardisation =
        Standardisation { mean: values(5), deviation: vec![0.5, 1.0, 2.0, 0.1, 3.0] };
    Network::new(standardisation, layers.map(|layer| layer.expect("whole rows")))
        .expect("matching layers")
}

fn description() -> VerifierDescription {
    VerifierDescription {
        policy: "cafe".to_owned(),
        input_size: 5,
        action_length: 7,
        options: TrainingOptions { hidden_sizes: [4, 3], ..TrainingOptions::default() },
        data: TrainingData::default(),
        held_out: Metrics::measure(&ScoredSamples::default(), 0.5),
        ranking: None,
    }
}

/// A verifier with arbitrary weights: 5 inputs, hidden layers of 4 and 3.
fn plain(seed: u64) -> Verifier {
    Verifier::new(&network(seed), None, &description()).expect("a whole verifier")
}

/// The same with a ranking that prefers higher confidence.
fn ranking(seed: u64) -> Verifier {
    let mut weights = vec![0.0; BRIDGE.length()];
    weights[0] = 0.25;
    let mut target_model = TargetModel::default();
    let map = TargetMap::new([[0.25, -0.5]; TERMS]).expect("finite");
    target_model.insert("stack the green block", Stage::Place, map);
    let ranking = Ranking::new(BRIDGE, weights, target_model).expect("finite");
    let gain = ReRankingGain { percentage_points: 1.0, standard_error: 0.5 };
    let (gain, medoid_gain) = (gain.clone(), gain);
    let evidence = RankingEvidence { episodes: 2, decisions: 20, gain, medoid_gain };
    let description = VerifierDescription { ranking: Some(evidence), ..description() };
    Verifier::new(&network(seed), Some(&ranking), &description).expect("a whole verifier")
}

/// A candidate with this log-probability of its first part.
fn candidate(log_probability: f32, hidden: &[f32]) -> Candidate {
    let mut confidence = vec![0.0; BRIDGE.confidence().len()];
    confidence[0] = log_probability;
    Candidate {
        tokens: Vec::new(),
        log_probability: -1.0,
        log_probabilities: Vec::new(),
        confidence,
        hidden: hidden.to_vec(),
        parsed: Ok(Parsed {
            reasoning: Reasoning::default(),
            action_tokens: vec![500; 7],
            actions: ActionChunk::single(vec![0.0; 7]).expect("finite"),
        }),
    }
}

fn malformed(hidden: &[f32]) -> Candidate {
    Candidate {
        parsed: Err(Malformed::new("expected an action, got none")),
        ..candidate(0.0, hidden)
    }
}

/// Scores candidates after `change` has modified the request.
fn score_with(
    verifier: &Verifier,
    candidates: &[Candidate],
    action_space: &ActionSpace,
    change: impl FnOnce(&mut ScoringRequest<'_>),
) -> anyhow::Result<Vec<f32>> {
    let image = Image { height: 0, width: 0, pixels: Vec::new().into() };
    let mut request = ScoringRequest {
        image: &image,
        state: &[0.3, -0.05, 0.1],
        instruction: "",
        candidates,
        tracked: TrackedObjects::default(),
        action_space,
    };
    change(&mut request);
    verifier.logits(&request)
}

fn score(verifier: &Verifier, candidates: &[Candidate]) -> anyhow::Result<Vec<f32>> {
    score_with(verifier, candidates, &space(), |_| ())
}

#[test]
fn the_network_scores_the_mean_state_and_the_ranking_compares_candidates() {
    // The second candidate is malformed: its hidden state must not contribute.
    let candidates = [candidate(-2.0, &[0.1; 5]), malformed(&[9.0; 5]), candidate(-1.0, &[0.5; 5])];
    let logits = score(&ranking(1), &candidates).expect("scores");
    let situation = network(1).logit(&[0.3; 5]);
    // Half a nat from the mean: 4 logits per probability x 0.25 x 0.5.
    for (found, expected) in [logits[0], logits[2]].iter().zip([situation - 0.5, situation + 0.5]) {
        assert!((found - expected).abs() < 1e-5, "{logits:?} around {situation}");
    }
}

#[test]
fn a_file_is_read_back_bit_for_bit() {
    for verifier in [plain(1), ranking(1)] {
        let again = Verifier::from_bytes(verifier.bytes(), "cafe").expect("the same policy");
        assert!(again.bytes() == verifier.bytes());
        assert_eq!(again.digest(), verifier.digest());
        assert_eq!(again.description(), verifier.description());
        assert_eq!(again.contents.network, verifier.contents.network);
        assert_eq!(again.contents.ranking, verifier.contents.ranking);
    }
    assert!(ranking(1).contents.ranking.is_some() && plain(1).contents.ranking.is_none());
    assert_eq!(plain(1).digest(), plain(1).digest());
    assert_ne!(plain(2).digest(), plain(1).digest());
}

#[test]
fn a_broken_file_is_refused() {
    let bytes = plain(1).bytes().to_vec();
    let refuse =
        |bytes: &[u8]| format!("{:#}", Verifier::from_bytes(bytes, "cafe").err().expect("refused"));
    assert!(refuse(&bytes[..bytes.len() - 1]).starts_with("verifier file: expected safetensors"));
    assert!(
        refuse(&[bytes.clone(), vec![0]].concat())
            .starts_with("verifier file: expected safetensors")
    );
    let plain =
        safetensors::serialize(Vec::<(String, safetensors::tensor::TensorView<'_>)>::new(), None);
    assert!(
        refuse(&plain.expect("an empty file")).contains("expected metadata \"rever.verifier\"")
    );
    // The last four bytes are a mean; they are replaced by NaN.
    let mut broken = bytes;
    let end = broken.len();
    broken[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    assert_eq!(refuse(&broken), "standardisation: expected finite means, got NaN or infinity");
}

#[test]
fn a_file_with_huge_weights_is_refused() {
    let tensors = |name: &str, values: usize| -> Vec<u8> {
        let bytes = ranking(1).bytes().to_vec();
        let file = safetensors::SafeTensors::deserialize(&bytes).expect("a file");
        let data = file.tensor(name).expect("a tensor").data();
        assert_eq!(data.len(), 4 * values, "{name}");
        let at = data.as_ptr() as usize - bytes.as_ptr() as usize;
        let mut huge = bytes.clone();
        huge[at..at + 4].copy_from_slice(&3e38_f32.to_le_bytes());
        huge
    };
    for (name, values, expected) in [
        ("output.weight", 3, "verifier network: expected sums of at most 1e30 for any 16-bit"),
        ("hidden_1.bias", 4, "verifier network: expected sums of at most 1e30 for any 16-bit"),
        ("standardisation.mean", 5, "verifier network: expected sums of at most 1e30"),
        ("ranking.weight", 26, "ranking weights: expected at most 1000000, got 3"),
        ("target.place.stack the green block", 30, "target map: expected coefficients of at most"),
    ] {
        let error = Verifier::from_bytes(&tensors(name, values), "cafe").err().expect(name);
        assert!(format!("{error:#}").contains(expected), "{name}: {error:#}");
    }
}

#[test]
fn a_verifier_of_another_policy_is_refused() {
    let error = Verifier::from_bytes(plain(1).bytes(), "beef").err().expect("another policy");
    assert_eq!(
        error.to_string(),
        "expected a verifier trained for policy beef, got one trained for policy cafe"
    );
}

#[test]
fn candidates_that_cannot_be_scored_are_an_error() {
    let refuse = |verifier: &Verifier, candidate: Candidate| {
        score(verifier, &[candidate]).expect_err("no scores").to_string()
    };
    for verifier in [plain(1), ranking(1)] {
        assert_eq!(
            refuse(&verifier, candidate(0.0, &[])),
            "expected a hidden state of 5 values, got 0"
        );
        for (value, shown) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf"), (7e4, "70000")] {
            assert_eq!(
                refuse(&verifier, candidate(0.0, &[0.0, 0.0, value, 0.0, 0.0])),
                format!("expected a hidden state of 16-bit floats, got {shown}")
            );
        }
    }
    let mut boundless = candidate(-1.0, &[0.0; 5]);
    boundless.confidence[0] = f32::NEG_INFINITY;
    assert_eq!(refuse(&ranking(1), boundless), "expected a finite score of candidate 0, got NaN");
    let shorter = ActionSpace { scale: vec![1.0; 6], gripper: None };
    let error = score_with(&ranking(1), &[candidate(0.0, &[0.0; 5])], &shorter, |_| ());
    assert_eq!(
        error.expect_err("another action length").to_string(),
        "expected a policy with 7 action dimensions, got 6"
    );
    // A malformed candidate needs no score.
    assert_eq!(score(&plain(1), &[malformed(&[])]).expect("scores"), [0.0]);
}

#[test]
fn a_score_does_not_depend_on_the_batch() {
    let candidates: Vec<Candidate> = (0..80)
        .map(|row| {
            let hidden: Vec<f32> = (0..5).map(|i| (row * 7 + i * 3) as f32 * 0.013 - 2.0).collect();
            candidate(-1.0, &hidden)
        })
        .collect();
    let together = score(&plain(1), &candidates).expect("scores");
    for (candidate, logit) in candidates.iter().zip(together) {
        let alone = score(&plain(1), std::slice::from_ref(candidate)).expect("scores");
        assert_eq!(alone[0].to_bits(), logit.to_bits());
    }
}

#[test]
fn a_missing_file_is_named() {
    let error =
        Verifier::load(Path::new("no/such/verifier.safetensors"), "cafe").err().expect("no file");
    assert!(error.to_string().contains("no/such/verifier.safetensors"), "{error:#}");
}

/// Numbers from -1 to 1 by a linear congruential generator.
struct Numbers(u32);

impl Numbers {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (self.0 >> 8) as f32 / 8_388_608.0 - 1.0
    }

    fn take(&mut self, count: usize, scale: f32, shift: f32) -> Vec<f32> {
        (0..count).map(|_| self.next() * scale + shift).collect()
    }

    fn candidate(&mut self) -> Candidate {
        let hidden = self.take(256, 3.0, 0.0);
        let confidence = self.take(16, 1.0, -1.0);
        let tokens = (0..7).map(|_| 500 + ((self.next() + 1.0) * 50.0) as u32).collect();
        let mut action = self.take(7, 0.02, 0.0);
        action[6] = if action[6] > 0.0 { 1.0 } else { -1.0 };
        let parsed = Parsed {
            reasoning: Reasoning::default(),
            action_tokens: tokens,
            actions: ActionChunk::single(action).expect("finite"),
        };
        Candidate { confidence, parsed: Ok(parsed), ..candidate(0.0, &hidden) }
    }
}

#[test]
fn the_shipped_verifier_gives_the_same_scores_as_when_it_was_trained() {
    // Computed at commit 091f8b1, which trained the file; only the name of its policy has changed
    // since.
    const EXPECTED: [(&str, Option<Stage>, [u32; 5]); 3] = [
        (
            "put carrot on plate",
            Some(Stage::Grasp),
            [0xc101_480e, 0xc11f_f9b0, 0xc100_e484, 0, 0xc119_911a],
        ),
        (
            "stack the green block on the yellow block",
            Some(Stage::Place),
            [0xc13d_127e, 0xc13d_1699, 0xc143_f6f2, 0, 0xc130_7326],
        ),
        ("unknown", None, [0xc114_ef6c, 0xc122_27f5, 0xc11f_1c08, 0xc118_4180, 0xc119_9c37]),
    ];
    let path =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/bridge-small/verifier.safetensors");
    let digest = "477a03016de020ee3db3ef87322d6d2b6e3e550e4922a775d84575189884dd7d";
    let verifier = Verifier::load(&path, digest).expect("the shipped file");
    assert_eq!(
        verifier.digest(),
        "807e73eac6e1587e811fbee0e8a1122e02d1ecfa748f3624d3be1fd54be70adf"
    );
    let space = ActionSpace { scale: vec![0.05, 0.06, 0.07, 0.0, 0.2, 0.3, 2.0], gripper: Some(6) };
    for (seed, (instruction, stage, expected)) in EXPECTED.into_iter().enumerate() {
        let mut numbers = Numbers(seed as u32 + 1);
        let mut candidates: Vec<Candidate> = (0..5).map(|_| numbers.candidate()).collect();
        if expected[3] == 0 {
            candidates[3].parsed = Err(Malformed::new("expected an action, got none"));
        }
        let bounds = [[100.0, 120.5, 130.0, 150.25], [60.0, 70.0, 110.0, 101.5]].map(Some);
        let logits = score_with(&verifier, &candidates, &space, |request| {
            request.instruction = instruction;
            request.tracked = TrackedObjects { stage, bounds };
        });
        let bits: Vec<u32> = logits.expect("scores").iter().map(|logit| logit.to_bits()).collect();
        assert_eq!(bits, expected, "{instruction}");
    }
}
