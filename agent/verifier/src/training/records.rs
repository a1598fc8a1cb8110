//! Reads training episodes from records and checks their eligibility.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use decision::{ActionSpace, Malformed, ObjectTracker, Parsed};
use protocol::{EpisodeOutcome, Statistics};
use store::labels;
use store::record::{DecisionRecord, EpisodeRecord, hidden_from_bytes};
use store::run::{record_path, recorded};

use super::decision_sample::{self, DecisionSample};
use super::eligibility::{ExclusionReason, exclude_label, exclude_record};
use super::set::{LayoutKey, TrainingEpisode};

/// Decodes recorded completions with the policy's code; records contain only tokens.
#[derive(Clone, Copy)]
pub struct CompletionReader<'a> {
    /// Digest of the policy of the verifier.
    pub policy: &'a str,
    /// How to compare its actions.
    pub action_space: &'a ActionSpace,
    /// Parses a candidate's tokens.
    pub parse: &'a dyn Fn(&[u32]) -> Result<Parsed, Malformed>,
    /// Computes the confidence of a candidate's parts from its tokens and their log-probabilities.
    pub confidence: ReadConfidence<'a>,
}

/// From tokens and their log-probabilities to one number per part.
pub type ReadConfidence<'a> = &'a dyn Fn(&[u32], &[f32]) -> Vec<f32>;

/// Number of excluded episodes by reason.
pub type Excluded = BTreeMap<&'static str, usize>;

/// The episodes of the given runs, and the number of those without an outcome. Fails and names the
/// record if one is ineligible for another reason.
///
/// These runs were named explicitly: silently excluding a part of them would hide a mistake.
pub fn from_runs(
    folders: &[PathBuf],
    reader: CompletionReader<'_>,
) -> anyhow::Result<(Vec<TrainingEpisode>, Excluded)> {
    let (mut episodes, mut excluded) = (Vec::new(), Excluded::new());
    for folder in folders {
        for id in recorded(folder)? {
            let path = record_path(folder, &id);
            let record = EpisodeRecord::read(&path)?;
            if !record.has_outcome() {
                *excluded.entry(ExclusionReason::NeverActed.summary()).or_insert(0) += 1;
                continue;
            }
            let episode = eligible_episode(&record, reader);
            episodes.push(episode.with_context(|| format!("record {}", path.display()))?);
        }
    }
    Ok((episodes, excluded))
}

/// The eligible episodes of a label store, and the number of excluded ones by reason.
///
/// Every run writes to the store, including evaluations, so most exclusions are expected here.
pub fn from_labels(
    path: &Path,
    reader: CompletionReader<'_>,
) -> anyhow::Result<(Vec<TrainingEpisode>, Excluded)> {
    let (mut episodes, mut excluded) = (Vec::new(), Excluded::new());
    for label in labels::labels(path)? {
        let reason = match (exclude_label(&label.outcome, reader.policy), label.record) {
            (Some(reason), _) => reason.summary(),
            (None, None) => "record on another machine",
            (None, Some(path)) => match record_of(&path, &label.outcome) {
                Err(reason) => reason,
                Ok(record) => match exclude_record(&record, reader.policy) {
                    Some(reason) => reason.summary(),
                    None => {
                        let episode = training_episode(&record, reader);
                        let episode = episode.with_context(|| format!("record {}", path.display()));
                        episodes.push(episode?);
                        continue;
                    }
                },
            },
        };
        *excluded.entry(reason).or_insert(0) += 1;
    }
    Ok((episodes, excluded))
}

/// The record of a label, or why it cannot be used: the run's folder may have been removed,
/// recreated or damaged. Such a record excludes one episode, not all others.
fn record_of(path: &Path, label: &EpisodeOutcome) -> Result<EpisodeRecord, &'static str> {
    if !path.exists() {
        return Err("record is missing");
    }
    let record = EpisodeRecord::read(path).map_err(|error| {
        tracing::warn!("excluded from training: {error:#}");
        "record cannot be read"
    })?;
    if record.identity.run != label.run {
        return Err("record of another run");
    }
    if labels::outcome(&record) != *label {
        tracing::warn!(
            "excluded from training: the record {} differs from its label",
            path.display()
        );
        return Err("record differs from its label");
    }
    Ok(record)
}

/// The record as a training episode; fails if it is not eligible.
pub fn eligible_episode(
    record: &EpisodeRecord,
    reader: CompletionReader<'_>,
) -> anyhow::Result<TrainingEpisode> {
    if let Some(reason) = exclude_record(record, reader.policy) {
        bail!(reason);
    }
    training_episode(record, reader)
}

fn training_episode(
    record: &EpisodeRecord,
    reader: CompletionReader<'_>,
) -> anyhow::Result<TrainingEpisode> {
    let (mut hidden, mut steps) = (Vec::new(), Vec::new());
    let mut decisions = (record.identity.candidates > 1).then(Vec::new);
    let (mut statistics, mut tracker) = (Statistics::default(), ObjectTracker::default());
    for (index, step) in record.steps.iter().enumerate() {
        let before = std::mem::replace(&mut statistics, step.statistics);
        let Some(decision) = &step.decision else { continue };
        let mut read = || -> anyhow::Result<(Option<Vec<f32>>, Option<DecisionSample>)> {
            let sample = match &decisions {
                None => None,
                Some(_) => {
                    decision_sample::read(decision, &step.state, before, &mut tracker, reader)?
                }
            };
            Ok((executed(decision)?, sample))
        };
        let (executed, sample) = read().with_context(|| format!("step {index}"))?;
        // Otherwise the robot held still: no candidate was executed.
        let Some(executed) = executed else { continue };
        hidden.extend(executed);
        steps.push(index);
        decisions = decisions.zip(sample).map(|(mut list, sample)| {
            list.push(sample);
            list
        });
    }
    let (identity, steps_total) = (&record.identity, record.steps.len());
    Ok(TrainingEpisode {
        name: format!("{}/{}", identity.run, identity.id()),
        start: LayoutKey { task: identity.task_id(), layout: identity.layout, seed: identity.seed },
        instruction: record.instruction.clone(),
        is_success: record.statistics.is_success,
        hidden,
        steps,
        steps_total,
        steps_max: record.steps_max as usize,
        decisions,
    })
}

/// The hidden state of the executed candidate; `None` if the robot held still.
fn executed(decision: &DecisionRecord) -> anyhow::Result<Option<Vec<f32>>> {
    let Some(chosen) = decision.chosen else { return Ok(None) };
    let drawn = decision.candidates.iter().position(|candidate| candidate.actions.is_some());
    ensure!(
        drawn == Some(chosen as usize),
        "expected the first well-formed candidate to be executed, got candidate {chosen}"
    );
    let hidden = decision.candidates[chosen as usize].hidden.as_ref();
    let hidden = hidden.context("expected the executed candidate's hidden state, got none")?;
    hidden_from_bytes(hidden).map(Some)
}

#[cfg(test)]
mod tests;
