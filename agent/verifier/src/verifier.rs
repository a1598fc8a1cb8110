//! The verifier: a network that scores the situation, a ranking of the candidates, and their
//! description.

use std::path::Path;

use anyhow::{Context, ensure};
use async_trait::async_trait;
use decision::{Candidate, Scorer, ScoringRequest};

use crate::file::{self, Contents};
use crate::{CandidateFeatures, Network, Ranking, VerifierDescription};

/// Maximum size of a verifier file, checked before it is read. Typical files have a few megabytes.
pub const FILE_BYTES_MAX: u64 = 64 * 1024 * 1024;

/// The slope of the logit at a probability of 1/2: logits per unit of probability.
pub const LOGITS_PER_PROBABILITY: f32 = 4.0;

/// A trained verifier for one policy.
pub struct Verifier {
    contents: Contents,
    /// The file's bytes, so that the digest always refers to this encoding.
    bytes: Vec<u8>,
    digest: String,
}

impl Verifier {
    /// Loads a verifier file and checks that it was trained for the policy with `policy_digest`.
    pub fn load(path: &Path, policy_digest: &str) -> anyhow::Result<Verifier> {
        let bytes = read_file(path);
        let verifier = bytes.and_then(|bytes| Verifier::from_bytes(&bytes, policy_digest));
        verifier.with_context(|| format!("verifier {}", path.display()))
    }

    /// Reads a verifier's file, whatever policy it was trained for: to be looked at.
    pub fn load_any(path: &Path) -> anyhow::Result<Verifier> {
        let bytes = read_file(path);
        let verifier = bytes.and_then(|bytes| Verifier::from_bytes_of_any_policy(&bytes));
        verifier.with_context(|| format!("verifier {}", path.display()))
    }

    /// Decodes a verifier file, for example one received over the network.
    pub fn from_bytes(bytes: &[u8], policy_digest: &str) -> anyhow::Result<Verifier> {
        let verifier = Verifier::from_bytes_of_any_policy(bytes)?;
        // Hidden states of another policy have another meaning: the scores would look plausible and
        // be noise.
        ensure!(
            verifier.description().policy == policy_digest,
            "expected a verifier trained for policy {policy_digest}, got one trained for policy {}",
            verifier.description().policy
        );
        Ok(verifier)
    }

    /// Decodes a verifier file for any policy, to show its description.
    pub fn from_bytes_of_any_policy(bytes: &[u8]) -> anyhow::Result<Verifier> {
        let contents = file::decode(bytes)?;
        Ok(Verifier { contents, bytes: bytes.to_vec(), digest: file::digest(bytes) })
    }

    /// Makes a verifier of trained weights and their description.
    ///
    /// It is encoded and decoded, so that it equals what every reader of the file gets.
    pub fn new(
        network: &Network,
        ranking: Option<&Ranking>,
        description: &VerifierDescription,
    ) -> anyhow::Result<Verifier> {
        Verifier::from_bytes_of_any_policy(&file::encode(network, ranking, description)?)
    }

    /// The contents of this verifier's file.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// SHA-256 of the file, in hexadecimal.
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// The description of the training and the measured quality.
    pub fn description(&self) -> &VerifierDescription {
        &self.contents.description
    }

    /// How it tells the candidates of one decision apart; none in a verifier that is a network alone.
    pub fn ranking(&self) -> Option<&Ranking> {
        self.contents.ranking.as_ref()
    }

    /// The logit of every candidate of one decision; finite for every well-formed one.
    ///
    /// Without a ranking a logit depends only on the candidate's hidden state. With a ranking, the
    /// network reads the mean hidden state, so that it cannot prefer a candidate that merely claims
    /// more progress, and the ranking distinguishes the candidates. The logit of a malformed
    /// candidate has no meaning.
    pub fn logits(&self, request: &ScoringRequest<'_>) -> anyhow::Result<Vec<f32>> {
        let ScoringRequest { candidates, .. } = *request;
        let Contents { network, ranking, .. } = &self.contents;
        let well_formed: Vec<&Candidate> =
            candidates.iter().filter(|candidate| candidate.parsed.is_ok()).collect();
        for candidate in &well_formed {
            network.check(&candidate.hidden)?;
        }
        let scores = match ranking {
            None => well_formed.iter().map(|candidate| network.logit(&candidate.hidden)).collect(),
            Some(ranking) => rank(network, ranking, request, &well_formed)?,
        };
        let mut scores = scores.into_iter();
        let logit = |(index, candidate): (usize, &Candidate)| {
            if candidate.parsed.is_err() {
                return Ok(0.0);
            }
            let logit =
                scores.next().context("expected a score for every well-formed candidate")?;
            ensure!(logit.is_finite(), "expected a finite score of candidate {index}, got {logit}");
            Ok(logit)
        };
        candidates.iter().enumerate().map(logit).collect()
    }
}

/// Of a size that the program accepts.
fn read_file(path: &Path) -> anyhow::Result<Vec<u8>> {
    let bytes = std::fs::metadata(path)?.len();
    ensure!(bytes <= FILE_BYTES_MAX, "expected at most {FILE_BYTES_MAX} bytes, got {bytes}");
    Ok(std::fs::read(path)?)
}

/// The logits of the well-formed candidates: the value of the situation plus each candidate's
/// advantage.
fn rank(
    network: &Network,
    ranking: &Ranking,
    request: &ScoringRequest<'_>,
    well_formed: &[&Candidate],
) -> anyhow::Result<Vec<f32>> {
    let ScoringRequest { candidates, action_space, instruction, tracked, state, .. } = request;
    let rows: Vec<&[f32]> = well_formed.iter().map(|candidate| &*candidate.hidden).collect();
    let situation = network.logit(&mean_hidden(&rows, network.input_size()));
    let (expected, got) = (ranking.layout().action_length, action_space.length());
    ensure!(got == expected, "expected a policy with {expected} action dimensions, got {got}");
    let mut features = CandidateFeatures::of(candidates, action_space)?;
    let gripper = state.first_chunk().copied();
    features.set_target(ranking.target_model().predict(instruction, tracked, gripper));
    let logit = |row: &Vec<f32>| situation + LOGITS_PER_PROBABILITY * ranking.advantage(row);
    Ok(features.rows().iter().map(logit).collect())
}

#[async_trait]
impl Scorer for Verifier {
    fn digest(&self) -> &str {
        &self.digest
    }

    async fn score(&self, requests: &[ScoringRequest<'_>]) -> Vec<anyhow::Result<Vec<f32>>> {
        requests.iter().map(|request| self.logits(request)).collect()
    }
}

/// The mean of hidden states of `size` values; zeros if there are none.
pub fn mean_hidden(rows: &[&[f32]], size: usize) -> Vec<f32> {
    let mut mean = vec![0.0; size];
    for row in rows {
        mean.iter_mut().zip(*row).for_each(|(mean, value)| *mean += value);
    }
    mean.iter_mut().for_each(|mean| *mean /= rows.len().max(1) as f32);
    mean
}

#[cfg(test)]
mod tests;
