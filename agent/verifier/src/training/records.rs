//! Training episodes from records: which are eligible, and what they become.

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

/// What the policy's own code says of recorded completions; records keep tokens.
#[derive(Clone, Copy)]
pub struct CompletionReader<'a> {
    /// Digest of the policy whose verifier is trained.
    pub policy: &'a str,
    /// How its actions compare.
    pub action_space: &'a ActionSpace,
    /// Reads a candidate's tokens.
    pub parse: &'a dyn Fn(&[u32]) -> Result<Parsed, Malformed>,
    /// How sure it was of a candidate's parts, from tokens and as many log-probabilities.
    pub confidence: ReadConfidence<'a>,
}

/// From tokens and as many log-probabilities to one number for each part.
pub type ReadConfidence<'a> = &'a dyn Fn(&[u32], &[f32]) -> Vec<f32>;

/// Numbers of excluded episodes by reason.
pub type Excluded = BTreeMap<&'static str, usize>;

/// The episodes of the given runs, and how many of them have no outcome; refuses, naming the record, when one is not
/// eligible for another reason.
///
/// A run was named by hand: leaving a part of it out in silence would hide a mistake.
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

/// The eligible episodes of a label store, and how many were excluded for which reason.
///
/// Every run feeds the store, evaluations included, so most exclusions are in order here.
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

/// The record of a label, or why it cannot be used: a run's folder may be removed and made again, or damaged. Such a
/// record costs the training one episode, not all others.
fn record_of(path: &Path, label: &EpisodeOutcome) -> Result<EpisodeRecord, &'static str> {
    if !path.exists() {
        return Err("record is gone");
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
            "excluded from training: the record {} disagrees with its label",
            path.display()
        );
        return Err("record disagrees with its label");
    }
    Ok(record)
}

/// The record as a training episode; refuses one that is not eligible.
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
        // Else the robot held still: no candidate was executed.
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

/// The hidden state of the executed candidate; none where the robot held still.
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
