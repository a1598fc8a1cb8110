//! The terms of recorded scores, computed again by the verifier that gave them and compared with what was recorded.

use std::path::Path;

use anyhow::{Result, ensure};
use decision::probability;
use evaluation::report::EpisodeTerms;
use store::record::{DecisionRecord, EpisodeRecord};
use verifier::{LOGITS_PER_PROBABILITY, Verifier, explain, term_names};

use crate::command::names::short;
use crate::command::recorded_policy::RecordedPolicy;
use crate::files::VERIFIER_FILE;

/// Terms whose scores differ by more than this from the recorded ones explain something else.
const SCORE_TOLERANCE: f64 = 1e-3;

/// A verifier, if there is one, and what reads the records that it scored.
pub struct ScoreTerms<'a> {
    verifier: Option<Verifier>,
    policy: &'a RecordedPolicy,
}

impl<'a> ScoreTerms<'a> {
    /// Loads the named verifier, or the one in the policy's folder if there is one.
    pub fn load(
        named: Option<&Path>,
        folder: Option<&Path>,
        policy: &'a RecordedPolicy,
    ) -> Result<ScoreTerms<'a>> {
        let beside = folder.map(|folder| folder.join(VERIFIER_FILE)).filter(|file| file.is_file());
        let verifier = match named {
            Some(path) => Some(Verifier::load(path, policy.digest())?),
            // One that does not belong to the policy did not score its candidates either.
            None => beside.and_then(|file| Verifier::load(&file, policy.digest()).ok()),
        };
        Ok(ScoreTerms { verifier, policy })
    }

    /// What each term is; none without a verifier that has terms.
    pub fn names(&self) -> Vec<String> {
        let ranking = self.verifier.as_ref().and_then(Verifier::ranking);
        ranking.map_or_else(Vec::new, |ranking| term_names(ranking.layout()))
    }

    /// The terms of all scores of an episode, or why there are none.
    pub fn of(&self, record: &EpisodeRecord) -> Result<EpisodeTerms> {
        let unknown = |reason: String| Ok(EpisodeTerms::Unknown(reason));
        if record.identity.candidates < 2 {
            return unknown("A single candidate has no siblings to be compared with.".to_owned());
        }
        let Some(digest) = &record.versions.verifier else {
            return unknown("No verifier scored this episode.".to_owned());
        };
        let Some(verifier) = self.verifier.as_ref().filter(|one| one.digest() == digest) else {
            return unknown(format!(
                "The terms of the scores are not shown: the verifier that gave them (digest {}…) was not available when \
                 this page was built. `rever report RUN --verifier FILE` shows them.",
                short(digest)
            ));
        };
        let explained = self.policy.with_reader(|reader| explain(verifier, record, reader))?;
        let Some(steps) = explained else {
            return unknown(
                "This verifier is a network without a ranking: its scores have no terms."
                    .to_owned(),
            );
        };
        for (index, (step, terms)) in record.steps.iter().zip(&steps).enumerate() {
            if let (Some(decision), Some(terms)) = (&step.decision, terms)
                && let Err(error) = agree(decision, terms)
            {
                return unknown(format!(
                    "The terms of the scores are not shown: computed again from the record, they do not give the \
                     recorded scores (step {index}: {error})."
                ));
            }
        }
        Ok(EpisodeTerms::Known(steps))
    }
}

/// Whether the terms give the recorded scores: the mean of the logits is the situation's, the terms are all that differs.
fn agree(decision: &DecisionRecord, terms: &[Vec<f32>]) -> Result<()> {
    let well_formed = decision.candidates.iter().filter(|one| one.actions.is_some());
    let scores: Vec<f64> = well_formed.filter_map(|one| one.score).map(f64::from).collect();
    ensure!(
        scores.len() == terms.len(),
        "expected {} scored candidates, got {}",
        terms.len(),
        scores.len()
    );
    // A score of exactly 0 or 1 has lost its logit.
    if scores.is_empty() || scores.iter().any(|score| *score <= 0.0 || *score >= 1.0) {
        return Ok(());
    }
    let logits = scores.iter().map(|score| (score / (1.0 - score)).ln());
    let situation = logits.sum::<f64>() / scores.len() as f64;
    for (score, row) in scores.iter().zip(terms) {
        let advantage: f64 = row.iter().copied().map(f64::from).sum();
        let logit = situation + f64::from(LOGITS_PER_PROBABILITY) * advantage;
        let found = f64::from(probability(logit as f32));
        ensure!(
            (found - score).abs() <= SCORE_TOLERANCE,
            "expected a score of {score:.4}, got {found:.4}"
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use store::record::CandidateRecord;

    #[test]
    fn terms_that_do_not_give_the_recorded_scores_are_noticed() {
        let candidate = |logit: f32| CandidateRecord {
            tokens: Vec::new(),
            actions: Some(decision::ActionChunk::single(vec![0.0]).expect("an action")),
            malformed: None,
            unread: Vec::new(),
            score: Some(probability(logit)),
            log_probability: 0.0,
            log_probabilities: Vec::new(),
            hidden: None,
            reading: None,
        };
        let candidates = [0.5_f32, 0.9].map(candidate).to_vec();
        let decision = DecisionRecord { candidates, chosen: Some(1), batch_ms: 1.0, batch_size: 1 };
        // A logit of 0.2 is an advantage of 0.05.
        agree(&decision, &[vec![-0.07, 0.02], vec![0.0, 0.05]]).expect("they give the scores");
        let error = agree(&decision, &[vec![0.05, 0.0], vec![-0.05, 0.0]]).expect_err("swapped");
        assert!(error.to_string().starts_with("expected a score of 0.6225"), "{error}");
        assert!(agree(&decision, &[vec![0.0]]).is_err(), "a candidate is missing");
    }
}
