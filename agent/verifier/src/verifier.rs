//! The verifier: says how likely the episode succeeds if a candidate is executed.
//!
//! ```text
//! last hidden states ─▶ mean ─▶ network (equation 4): how promising the situation is ─┐
//! log-probabilities, actions ─▶ against the siblings ─▶ choice: which is better ──────┴▶ logit of each
//! where it sees the objects, all steps so far ─▶ aim: where the gripper should go ─┘
//! ```

mod aim;
mod choice;
mod description;
mod file;
mod metrics;
mod network;

use std::path::Path;

use anyhow::{Context, ensure};

pub use aim::{TargetModel, BoundingBox, ObjectTracker, TrackedObjects, Place, STAGES, Stage, TERMS, Target, ReasoningFeatures, terms};
pub use choice::{
    AIM, Choice, FEATURES, Features, NEARNESS, PENALTIES, Sibling, features, retarget,
};
pub use description::{ChoiceEvidence, Description, Evidence, Gain, Options};
pub use metrics::{Discrimination, HeldOut, Metrics, weighted_loss};
pub use network::{Layer, Network, Standardisation};

/// A verifier file larger than this is refused before it is read: the largest sensible one is a few megabytes.
pub const FILE_BYTES_MAX: u64 = 64 * 1024 * 1024;

/// Logits per unit of probability: the slope of the logit where success and failure are equally likely.
const LOGITS_PER_PROBABILITY: f32 = 4.0;

/// The candidates of one decision, as the verifier sees them; the lists run in parallel.
#[derive(Clone, Copy, Debug)]
pub struct Siblings<'a> {
    /// Each candidate's last hidden state.
    pub hidden: &'a [&'a [f32]],
    /// What tells it from the others; `None` is a malformed one.
    pub candidates: &'a [Option<Sibling>],
    /// One unit of each number of an action.
    pub action_scale: &'a [f32; 7],
    /// What the robot was told.
    pub instruction: &'a str,
    /// Where the gripper is: x and y in the base frame, metres.
    pub gripper: [f32; 2],
    /// What was said in this episode, these candidates included.
    pub tracked: TrackedObjects,
}

/// A trained verifier for one policy.
pub struct Verifier {
    network: Network,
    choice: Option<Choice>,
    description: Description,
    /// The file that this is, so that a digest is never of a second encoding.
    bytes: Vec<u8>,
    digest: String,
}

impl Verifier {
    /// Reads a verifier file; refuses one that was trained for another policy than the one with `policy_digest`.
    pub fn load(path: &Path, policy_digest: &str) -> anyhow::Result<Verifier> {
        let read = || {
            let bytes_found = std::fs::metadata(path)?.len();
            ensure!(
                bytes_found <= FILE_BYTES_MAX,
                "expected at most {FILE_BYTES_MAX} bytes, got {bytes_found}"
            );
            Verifier::from_bytes(&std::fs::read(path)?, policy_digest)
        };
        read().with_context(|| format!("verifier {}", path.display()))
    }

    /// Reads the contents of a verifier file, for example as they came over the wire.
    pub fn from_bytes(bytes: &[u8], policy_digest: &str) -> anyhow::Result<Verifier> {
        let verifier = Verifier::from_bytes_of_any_policy(bytes)?;
        // Hidden states of another policy mean something else: the scores would look fine and be noise.
        ensure!(
            verifier.description.policy == policy_digest,
            "expected a verifier trained for policy {policy_digest}, got one trained for policy {}",
            verifier.description.policy
        );
        Ok(verifier)
    }

    /// Reads a verifier file only to show what it says about itself.
    pub fn from_bytes_of_any_policy(bytes: &[u8]) -> anyhow::Result<Verifier> {
        let (network, choice, description) = file::decode(bytes)?;
        let digest = file::digest(bytes);
        Ok(Verifier { network, choice, description, bytes: bytes.to_vec(), digest })
    }

    /// Joins trained weights with what is known about them.
    ///
    /// It is made into a file and read back, so that it is in memory exactly what any reader of the file gets.
    pub fn new(
        network: &Network,
        choice: Option<&Choice>,
        description: &Description,
    ) -> anyhow::Result<Verifier> {
        Verifier::from_bytes_of_any_policy(&file::encode(network, choice, description)?)
    }

    /// The contents of this verifier's file.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// SHA-256 of the file, in hexadecimal.
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// What the file says about the training and its measured quality.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// The logit of every candidate of one decision.
    ///
    /// Without a choice part a logit depends on the candidate's own hidden state alone. With it, the network reads the
    /// mean hidden state, so that it cannot prefer the candidate that merely claims more progress, and the choice part
    /// tells the candidates apart. A malformed candidate's logit means nothing.
    pub fn logits(&self, siblings: &Siblings<'_>) -> Vec<f32> {
        let Siblings { hidden, candidates, action_scale, instruction, gripper, tracked } = siblings;
        assert_eq!(hidden.len(), candidates.len(), "one hidden state per candidate");
        let Some(choice) = &self.choice else {
            return hidden.iter().map(|row| self.network.logit(row)).collect();
        };
        let well_formed = hidden.iter().zip(*candidates).filter(|(_, one)| one.is_some());
        let rows: Vec<&[f32]> = well_formed.map(|(row, _)| *row).collect();
        let situation = self.network.logit(&mean_hidden(&rows, self.network.input_size()));
        let logit = |features: Option<Features>| {
            let advantage = features.map_or(0.0, |features| choice.advantage(&features));
            situation + LOGITS_PER_PROBABILITY * advantage
        };
        let target = choice.target_model().target(instruction, tracked, *gripper);
        features(candidates, action_scale, target).into_iter().map(logit).collect()
    }
}

/// The mean of hidden states of `size` values; zeros when there is none.
pub fn mean_hidden(rows: &[&[f32]], size: usize) -> Vec<f32> {
    let mut mean = vec![0.0; size];
    for row in rows {
        mean.iter_mut().zip(*row).for_each(|(mean, value)| *mean += value);
    }
    mean.iter_mut().for_each(|mean| *mean /= rows.len().max(1) as f32);
    mean
}

/// The probability that belongs to a logit.
pub fn probability(logit: f32) -> f32 {
    (1.0 / (1.0 + (-f64::from(logit)).exp())) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use decision::CandidateAction;
    use rand::{Rng, SeedableRng, rngs::StdRng};

    /// A verifier with arbitrary weights: 5 inputs, hidden layers of 4 and 3.
    pub fn arbitrary(seed: u64) -> Verifier {
        let mut random = StdRng::seed_from_u64(seed);
        let mut values = |count: usize| -> Vec<f32> {
            (0..count).map(|_| random.random_range(-1.0..1.0)).collect()
        };
        let layers = [
            Layer::new(values(20), values(4)),
            Layer::new(values(12), values(3)),
            Layer::new(values(3), values(1)),
        ];
        let standardisation =
            Standardisation { mean: values(5), deviation: vec![0.5, 1.0, 2.0, 0.1, 3.0] };
        let network = Network::new(standardisation, layers.map(|layer| layer.expect("whole rows")))
            .expect("matching layers");
        let description = Description {
            policy: "cafe".to_owned(),
            input_size: 5,
            options: Options { hidden_sizes: [4, 3], ..Options::default() },
            evidence: Evidence::default(),
            held_out: Metrics::measure(&HeldOut::default(), 0.5),
            choice: None,
        };
        Verifier::new(&network, None, &description).expect("a whole verifier")
    }

    /// The same with weights that prefer what the policy was surer of.
    fn choosing(seed: u64) -> Verifier {
        let plain = arbitrary(seed);
        let mut weights = [0.0; FEATURES];
        weights[0] = 0.25;
        let mut target_model = TargetModel::default();
        let place = Place::new([[0.25, -0.5]; TERMS]).expect("finite");
        target_model.insert("stack the green block", Stage::Place, place);
        let choice = Choice::new(weights, target_model).expect("finite");
        let gain = Gain { points: 1.0, standard_error: 0.5 };
        let (gain, medoid_gain) = (gain.clone(), gain);
        let evidence = ChoiceEvidence { episodes: 2, decisions: 20, gain, medoid_gain };
        let description = Description { choice: Some(evidence), ..plain.description.clone() };
        Verifier::new(&plain.network, Some(&choice), &description).expect("a whole verifier")
    }

    /// A candidate that differs from others in the log-probability of its first part.
    fn sure(log_probability: f32) -> Option<Sibling> {
        let action = CandidateAction { tokens: [500; 7], action: [0.0; 7] };
        let mut confidence = [0.0; crate::policy::PARTS];
        confidence[0] = log_probability;
        Some(Sibling { action, confidence, words: None })
    }

    /// Logits of hidden states whose candidates are alike.
    fn alike(verifier: &Verifier, hidden: &[&[f32]]) -> Vec<f32> {
        logits(verifier, hidden, &vec![sure(-1.0); hidden.len()])
    }

    fn logits(verifier: &Verifier, hidden: &[&[f32]], candidates: &[Option<Sibling>]) -> Vec<f32> {
        verifier.logits(&Siblings {
            hidden,
            candidates,
            action_scale: &[1.0; 7],
            instruction: "",
            gripper: [0.0; 2],
            tracked: TrackedObjects::default(),
        })
    }

    #[test]
    fn the_choice_part_ranks_and_the_situation_is_that_of_the_mean() {
        let verifier = choosing(1);
        let rows: [&[f32]; 3] = [&[0.1; 5], &[9.0; 5], &[0.5; 5]];
        // The second is malformed: its hidden state must not count.
        let candidates = [sure(-2.0), None, sure(-1.0)];
        let logits = logits(&verifier, &rows, &candidates);
        let situation = verifier.network.logit(&[0.3; 5]);
        // Half a nat off the mean: 4 logits per probability x 0.25 x 0.5.
        for (found, expected) in logits.iter().zip([situation - 0.5, situation, situation + 0.5]) {
            assert!((found - expected).abs() < 1e-5, "{logits:?} around {situation}");
        }
    }

    #[test]
    fn a_file_is_read_back_bit_for_bit() {
        let verifier = arbitrary(1);
        let again = Verifier::from_bytes(verifier.bytes(), "cafe").expect("the same policy");
        assert!(again.bytes() == verifier.bytes());
        assert_eq!(again.digest(), verifier.digest());
        assert_eq!(again.description(), verifier.description());
        assert_eq!(again.network, verifier.network);
        let choosing = choosing(1);
        let again = Verifier::from_bytes(choosing.bytes(), "cafe").expect("the same policy");
        assert_eq!((&again.choice, again.bytes()), (&choosing.choice, choosing.bytes()));
        assert!(again.choice.is_some() && verifier.choice.is_none());
        assert_eq!(arbitrary(1).digest(), verifier.digest());
        assert_ne!(arbitrary(2).digest(), verifier.digest());
    }

    #[test]
    fn a_broken_file_is_refused() {
        let bytes = arbitrary(1).bytes().to_vec();
        let refuse = |bytes: &[u8]| {
            format!("{:#}", Verifier::from_bytes(bytes, "cafe").err().expect("refused"))
        };
        assert!(
            refuse(&bytes[..bytes.len() - 1]).starts_with("verifier file: expected safetensors")
        );
        assert!(
            refuse(&[bytes.clone(), vec![0]].concat())
                .starts_with("verifier file: expected safetensors")
        );
        let plain = safetensors::serialize(
            Vec::<(String, safetensors::tensor::TensorView<'_>)>::new(),
            None,
        );
        assert!(
            refuse(&plain.expect("an empty file")).contains("expected metadata \"rever.verifier\"")
        );
        // The last four bytes are a mean; NaN in place of it.
        let mut broken = bytes.clone();
        let end = broken.len();
        broken[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
        assert_eq!(refuse(&broken), "standardisation: expected finite means");
    }

    #[test]
    fn a_verifier_of_another_policy_is_refused() {
        let error =
            Verifier::from_bytes(arbitrary(1).bytes(), "beef").err().expect("another policy");
        assert_eq!(
            error.to_string(),
            "expected a verifier trained for policy beef, got one trained for policy cafe"
        );
    }

    #[test]
    fn a_row_does_not_depend_on_its_batch() {
        let verifier = arbitrary(1);
        let rows: Vec<Vec<f32>> = (0..80)
            .map(|row| (0..5).map(|i| (row * 7 + i * 3) as f32 * 0.013 - 2.0).collect())
            .collect();
        let rows: Vec<&[f32]> = rows.iter().map(Vec::as_slice).collect();
        let together = alike(&verifier, &rows);
        for (row, logit) in rows.iter().zip(together) {
            assert_eq!(alike(&verifier, &[row])[0].to_bits(), logit.to_bits());
        }
    }

    #[test]
    fn probabilities_are_right_far_from_zero() {
        assert_eq!(probability(0.0), 0.5);
        assert_eq!(probability(100.0), 1.0);
        assert!(probability(-100.0) > 0.0 && probability(-100.0) < 1e-40);
        assert_eq!(probability(-1000.0), 0.0);
        assert!((f64::from(probability(1.5)) - 0.817_574_476).abs() < 1e-7);
    }

    #[test]
    fn a_missing_file_is_named() {
        let error = Verifier::load(Path::new("no/such/verifier.safetensors"), "cafe")
            .err()
            .expect("no file");
        assert!(error.to_string().contains("no/such/verifier.safetensors"), "{error:#}");
    }
}
