//! Which records may teach the verifier, and what they become.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use protocol::{EpisodeOutcome, Statistics};

use super::objection::object;
use super::{LabelledEpisode, decision};
use store::labels::{LabelStore, outcome};
use vla::Confidence;
use store::record::{EpisodeRecord, hidden_from_bytes};
use store::run::{record_path, recorded};
use decision::Strategy;
use decision::{ObjectTracker, ReasoningFeatures};

/// What records are read for.
#[derive(Clone, Copy)]
pub struct Reader<'a> {
    /// Digest of the policy whose verifier is trained.
    pub policy: &'a str,
    /// One unit of each number of its actions.
    pub action_scale: &'a [f32; 7],
    /// How sure it was of a candidate's parts, from tokens and log-probabilities.
    pub confidence: &'a dyn Fn(&[u32], &[f32]) -> Confidence,
    /// Where a candidate sees what, from its tokens.
    pub words: &'a dyn Fn(&[u32]) -> Option<ReasoningFeatures>,
}

/// All episodes of the given runs; refuses, naming the record, when one of them must not teach.
///
/// A run was named by hand: leaving a part of it out in silence would hide a mistake.
pub fn from_runs(folders: &[PathBuf], reader: Reader<'_>) -> anyhow::Result<Vec<LabelledEpisode>> {
    let mut episodes = Vec::new();
    for folder in folders {
        for id in recorded(folder)? {
            let path = record_path(folder, &id);
            let record = EpisodeRecord::read(&path)?;
            episodes.push(
                labelled(&record, reader).with_context(|| format!("record {}", path.display()))?,
            );
        }
    }
    Ok(episodes)
}

/// The episodes of a label store that may teach, and how many were set aside for which reason.
///
/// A store is fed by every run, evaluations included, so most objections are in order here.
pub fn from_labels(
    path: &Path,
    reader: Reader<'_>,
) -> anyhow::Result<(Vec<LabelledEpisode>, BTreeMap<&'static str, usize>)> {
    // Opening would make an empty store.
    ensure!(path.is_file(), "label store {}: expected a file, got none", path.display());
    let (mut episodes, mut set_aside) = (Vec::new(), BTreeMap::new());
    for label in LabelStore::open(path)?.labels()? {
        let reason = match (object(&label.outcome, reader.policy), label.record) {
            (Some(objection), _) => objection.reason(),
            (None, None) => "record on another machine",
            (None, Some(path)) => match of_label(&path, &label.outcome)? {
                Ok(record) => {
                    let episode = labelled(&record, reader);
                    let episode = episode.with_context(|| format!("record {}", path.display()));
                    episodes.push(episode?);
                    continue;
                }
                Err(reason) => reason,
            },
        };
        *set_aside.entry(reason).or_insert(0) += 1;
    }
    Ok((episodes, set_aside))
}

/// The record of a label, or why it is no longer there: a run's folder may be removed, and made again.
fn of_label(
    path: &Path,
    label: &EpisodeOutcome,
) -> anyhow::Result<Result<EpisodeRecord, &'static str>> {
    if !path.exists() {
        return Ok(Err("record is gone"));
    }
    let record = EpisodeRecord::read(path)?;
    if record.identity.run != label.run {
        return Ok(Err("record of another run"));
    }
    let name = path.display();
    ensure!(outcome(&record) == *label, "record {name}: expected its label's episode, got another");
    Ok(Ok(record))
}

/// The record as training samples; refuses what must not teach.
pub fn labelled(record: &EpisodeRecord, reader: Reader<'_>) -> anyhow::Result<LabelledEpisode> {
    if let Some(objection) = object(&outcome(record), reader.policy) {
        bail!(objection);
    }
    let (mut hidden, mut steps) = (Vec::new(), Vec::new());
    // A chosen candidate would make a good choice look like a good candidate.
    let is_drawn = record.identity.strategy == Strategy::Sample.name();
    let mut decisions = (is_drawn && record.identity.candidates > 1).then(Vec::new);
    let (mut statistics, mut memory) = (Statistics::default(), ObjectTracker::default());
    for (index, step) in record.steps.iter().enumerate() {
        let before = std::mem::replace(&mut statistics, step.statistics);
        // What was said in a step is remembered, as when it was scored, whether or not one of it was executed.
        let sample = match &decisions {
            Some(_) => decision::read(step, before, &mut memory, reader)
                .with_context(|| format!("step {index}"))?,
            None => None,
        };
        // The robot held still: nothing that the policy said was executed.
        let Some(chosen) = step.chosen else { continue };
        let candidate = step.candidates.get(chosen as usize);
        let bytes = candidate.and_then(|candidate| candidate.hidden.as_ref());
        let bytes = bytes.with_context(|| {
            format!("step {index}: expected the chosen candidate's hidden state, got none")
        })?;
        hidden.extend(hidden_from_bytes(bytes).with_context(|| format!("step {index}"))?);
        steps.push(index);
        if let Some(list) = &mut decisions {
            match sample {
                Some(sample) if chosen == 0 => list.push(sample),
                _ => decisions = None,
            }
        }
    }
    Ok(LabelledEpisode {
        name: format!("{}/{}", record.identity.run, record.identity.id()),
        task: record.identity.task.clone(),
        instruction: record.instruction.clone(),
        is_success: record.statistics.is_success,
        hidden,
        steps,
        steps_total: record.steps.len(),
        decisions,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use store::labels::Label;
    use vla::PARTS;
    use store::record::{CandidateRecord, EpisodeIdentity, RECORD_VERSION, StepRecord, Versions, hidden_to_bytes};
    use store::plan::SeedRange;
    use crate::training::STATISTICS;
    use protocol::Statistics;

    /// The first part's confidence is the first token's log-probability.
    const CAFE: Reader<'_> = Reader {
        policy: "cafe",
        action_scale: &[1.0; 7],
        confidence: &|_, log_probabilities| {
            let mut confidence = [0.0; PARTS];
            confidence[0] = log_probabilities[0];
            confidence
        },
        words: &|_| None,
    };

    /// Three steps with two candidates each; the second is executed, except in the last step, in which none is.
    fn record(episode: u32) -> EpisodeRecord {
        let candidate = |value: f32| CandidateRecord {
            tokens: vec![1; 7],
            action: Some([0.0; 7]),
            malformed: None,
            score: None,
            log_probability: -1.0,
            log_probabilities: vec![-0.5; 7],
            hidden: Some(hidden_to_bytes(&[value, 0.5])),
        };
        let step = |index: usize| StepRecord {
            state: [0.0; 8],
            candidates: vec![candidate(-9.0), candidate(index as f32)],
            chosen: (index < 2).then_some(1),
            statistics: Statistics::default(),
            decision_ms: 1.0,
            step_ms: 1.0,
            simulator_ms: None,
        };
        EpisodeRecord {
            version: RECORD_VERSION,
            identity: EpisodeIdentity {
                run: "run-1".to_owned(),
                task: "widowx_stack_cube".to_owned(),
                variant: "default".to_owned(),
                layout: None,
                episode,
                seed: SeedRange::Collection.first() + u64::from(episode),
                sampling_seed: 5,
                strategy: "sample".to_owned(),
                candidates: 2,
                temperature: 1.0,
            },
            versions: Versions {
                rever: "0.0.0".to_owned(),
                protocol: 1,
                simulator: "mujoco 3.8.0".to_owned(),
                policy: "cafe".to_owned(),
                verifier: None,
            },
            instruction: "stack".to_owned(),
            statistics: Statistics { is_success: true, ..Statistics::default() },
            steps: (0..3).map(step).collect(),
            wall_secs: 1.0,
        }
    }

    fn write(folder: &Path, records: &[EpisodeRecord]) {
        std::fs::create_dir_all(folder.join("episodes")).expect("a folder");
        for record in records {
            record.write(&record_path(folder, &record.identity.id())).expect("a record");
        }
    }

    #[test]
    fn a_record_gives_the_executed_candidates_of_the_steps_that_had_one() {
        let episode = labelled(&record(3), CAFE).expect("it may teach");
        assert_eq!(episode.name, "run-1/widowx_stack_cube-default-0003-sample-n2-t1");
        assert_eq!(episode.hidden, [0.0, 0.5, 1.0, 0.5]);
        assert_eq!((episode.steps, episode.steps_total, episode.is_success), (vec![0, 1], 3, true));
    }

    #[test]
    fn drawn_candidates_teach_choosing_and_chosen_ones_do_not() {
        let mut record = record(0);
        record.steps.iter_mut().for_each(|step| step.chosen = step.chosen.map(|_| 0));
        record.steps[0].statistics.is_grasped = true;
        record.steps[1].candidates[1].log_probabilities[0] = -1.5;
        let decisions =
            |record: &EpisodeRecord| labelled(record, CAFE).expect("it may teach").decisions;
        let drawn = decisions(&record).expect("drawn of two");
        assert_eq!(drawn.len(), 2);
        let last = &drawn[1];
        // Hidden states -9 and 1, and the grasp of the step before.
        assert_eq!(
            (last.hidden_mean.as_slice(), last.statistics[1]),
            ([-4.0, 0.5].as_slice(), 1.0)
        );
        assert_eq!((last.candidates[0][0], last.candidates[1][0]), (0.5, -0.5));
        assert_eq!(drawn[0].statistics, [0.0; STATISTICS]);

        let mut forgotten = record.clone();
        forgotten.steps[1].candidates[1].hidden = None;
        assert!(decisions(&forgotten).is_none());
        record.identity.strategy = "medoid".to_owned();
        assert!(decisions(&record).is_none());
    }

    #[test]
    fn what_must_not_teach_is_refused_in_words() {
        let check = |change: fn(&mut EpisodeRecord), expected: &str| {
            let mut record = record(0);
            change(&mut record);
            let error = labelled(&record, CAFE).expect_err(expected);
            assert_eq!(error.to_string(), expected);
        };
        check(
            |record| record.identity.layout = Some(7),
            "expected a random layout, got layout 7",
        );
        check(
            |record| record.identity.seed = SeedRange::Evaluation.first(),
            "expected a seed of the collection range from 1000000000 on, got 3000000000",
        );
        check(
            |record| record.identity.seed = SeedRange::Tuning.first() + 5,
            "expected a seed of the collection range from 1000000000 on, got 2000000005",
        );
        check(|record| record.identity.temperature = 0.0, "expected a temperature above 0, got 0");
        check(
            |record| record.identity.strategy = "oracle".to_owned(),
            "expected a strategy that does without the expert, got oracle",
        );
        check(
            |record| record.versions.policy = "beef".to_owned(),
            "expected hidden states of the policy to train for, got policy beef",
        );
        check(|record| record.steps.clear(), "expected an outcome, got an episode without steps");
        check(
            |record| record.steps[1].candidates[1].hidden = None,
            "step 1: expected the chosen candidate's hidden state, got none",
        );
    }

    #[test]
    fn a_run_with_one_bad_record_is_refused_by_its_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let runs = [folder.path().to_path_buf()];
        write(folder.path(), &[record(0), record(1)]);
        assert_eq!(from_runs(&runs, CAFE).expect("two episodes").len(), 2);
        let mut bad = record(2);
        bad.identity.layout = Some(7);
        write(folder.path(), &[bad]);
        let error = format!("{:#}", from_runs(&runs, CAFE).expect_err("one is bad"));
        assert!(
            error
                .contains("widowx_stack_cube-default-0002-sample-n2-t1.msgpack: expected a random"),
            "{error}"
        );
    }

    #[test]
    fn a_label_store_sets_aside_what_must_not_teach_and_counts_it() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut records = [record(0), record(1), record(2), record(3)];
        records[1].identity.seed = SeedRange::Evaluation.first();
        records[2].versions.policy = "beef".to_owned();
        write(folder.path(), &records);
        let path = folder.path().join("labels.sqlite");
        let store = LabelStore::open(&path).expect("a store");
        for record in &records[..3] {
            let path = record_path(folder.path(), &record.identity.id());
            assert!(store.insert(&Label::new(record, &path)).expect("a row"));
        }
        assert!(store.insert(&Label::of_outcome(outcome(&records[3]))).expect("a row"));
        drop(store);
        let (episodes, set_aside) = from_labels(&path, CAFE).expect("a whole store");
        assert_eq!(episodes.len(), 1);
        let expected = [
            ("another policy", 1),
            ("record on another machine", 1),
            ("seed outside of the collection range", 1),
        ];
        assert_eq!(set_aside, BTreeMap::from(expected));

        // Removed, and made again with the same options.
        records[0].identity.run = "again".to_owned();
        write(folder.path(), &records[..1]);
        let set_aside = from_labels(&path, CAFE).expect("a whole store").1;
        assert_eq!(set_aside["record of another run"], 1);
        std::fs::remove_file(record_path(folder.path(), &records[0].identity.id()))
            .expect("it is there");
        let set_aside = from_labels(&path, CAFE).expect("a whole store").1;
        assert_eq!(set_aside["record is gone"], 1);
        let missing = from_labels(&folder.path().join("none.sqlite"), CAFE).expect_err("no store");
        assert!(
            missing.to_string().ends_with("none.sqlite: expected a file, got none"),
            "{missing}"
        );
    }
}
