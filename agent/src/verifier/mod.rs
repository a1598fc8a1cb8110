//! The verifier: a small network that reads a candidate's last hidden state and says how likely the episode succeeds.

mod description;
mod file;
mod metrics;
mod network;

use std::path::Path;

use anyhow::{Context, ensure};

pub use description::{Description, Evidence, Options};
pub use metrics::{Discrimination, HeldOut, Metrics, weighted_loss};
pub use network::{Layer, Network, Standardisation};

/// A verifier file larger than this is refused before it is read: the largest sensible one is a few megabytes.
pub const FILE_BYTES_MAX: u64 = 64 * 1024 * 1024;

/// A trained verifier for one policy.
pub struct Verifier {
    network: Network,
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
        let (network, description) = file::decode(bytes)?;
        let digest = file::digest(bytes);
        Ok(Verifier { network, description, bytes: bytes.to_vec(), digest })
    }

    /// Joins a trained network with what is known about it.
    ///
    /// It is made into a file and read back, so that it is in memory exactly what any reader of the file gets.
    pub fn new(network: &Network, description: &Description) -> anyhow::Result<Verifier> {
        Verifier::from_bytes_of_any_policy(&file::encode(network, description)?)
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

    /// The logit of every row, a row being one candidate's last hidden state.
    ///
    /// A row's logit depends on that row alone, to the last bit, whatever else is in the batch.
    pub fn logits(&self, rows: &[&[f32]]) -> Vec<f32> {
        rows.iter().map(|row| self.network.logit(row)).collect()
    }
}

/// The probability that belongs to a logit.
pub fn probability(logit: f32) -> f32 {
    (1.0 / (1.0 + (-f64::from(logit)).exp())) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
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
        };
        Verifier::new(&network, &description).expect("a whole verifier")
    }

    #[test]
    fn a_file_is_read_back_bit_for_bit() {
        let verifier = arbitrary(1);
        let again = Verifier::from_bytes(verifier.bytes(), "cafe").expect("the same policy");
        assert!(again.bytes() == verifier.bytes());
        assert_eq!(again.digest(), verifier.digest());
        assert_eq!(again.description(), verifier.description());
        assert_eq!(again.network, verifier.network);
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
        let together = verifier.logits(&rows);
        for (row, logit) in rows.iter().zip(together) {
            assert_eq!(verifier.logits(&[row])[0].to_bits(), logit.to_bits());
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
