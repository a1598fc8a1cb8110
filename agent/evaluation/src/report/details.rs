//! The steps of one episode as the page needs them: repeated phrases once, numbers short.

use std::collections::HashMap;

use anyhow::Context;
use decision::{Action, Reasoning};
use serde::Serialize;

use store::record::{CandidateRecord, DecisionRecord, EpisodeRecord, StepRecord};

use super::{EpisodeTerms, Readers};

/// What `data/{id}.js` hands to the page.
#[derive(Serialize)]
pub struct Details {
    id: String,
    phrases: Vec<String>,
    /// Why there are no terms of the scores, where there are none.
    #[serde(skip_serializing_if = "Option::is_none")]
    no_terms: Option<String>,
    steps: Vec<Step>,
}

/// Terms of a score that are listed one by one; the others are summed.
const TERMS_LISTED: usize = 5;

#[derive(Serialize)]
struct Step {
    chosen: Option<u32>,
    /// One bit per statistic, in the page's order.
    flags: u16,
    /// None for a step that executes a further action of the chunk decided before.
    decision_ms: Option<f32>,
    candidates: Vec<Candidate>,
}

/// Well-formed candidates have an action and what they said, malformed ones the reason and the raw text.
#[derive(Serialize)]
#[serde(untagged)]
enum Candidate {
    Reading {
        score: Option<f64>,
        log: f64,
        /// The largest terms of its advantage in percentage points: which, and how much; then the sum of the others.
        #[serde(skip_serializing_if = "Option::is_none")]
        terms: Option<(Vec<(usize, f64)>, f64)>,
        /// One list of numbers per action of the chunk.
        actions: Vec<Vec<f64>>,
        /// Task, plan, subtask reasoning, subtask, move reasoning, move.
        says: [usize; 6],
        /// Name, left, top, right, bottom.
        boxes: Vec<(usize, u16, u16, u16, u16)>,
        gripper: Vec<[u16; 2]>,
        /// The sections that were only partly read, with reasons.
        #[serde(skip_serializing_if = "Vec::is_empty")]
        unread: Vec<usize>,
    },
    Malformed {
        score: Option<f64>,
        log: f64,
        malformed: usize,
        text: usize,
    },
}

/// Phrases by number, each kept once.
#[derive(Default)]
struct Phrases {
    numbers: HashMap<String, usize>,
    list: Vec<String>,
}

impl Phrases {
    fn number(&mut self, phrase: String) -> usize {
        *self.numbers.entry(phrase).or_insert_with_key(|phrase| {
            self.list.push(phrase.clone());
            self.list.len() - 1
        })
    }
}

impl Details {
    /// Rebuilds what was said from the tokens of a record, and why it was scored as it was.
    pub fn new(record: &EpisodeRecord, readers: &Readers<'_>) -> anyhow::Result<Self> {
        let explain = || -> anyhow::Result<Self> {
            let (terms, no_terms) = match (readers.explain)(record)? {
                EpisodeTerms::Known(steps) => (steps, None),
                EpisodeTerms::Unknown(reason) => (Vec::new(), Some(reason)),
            };
            let mut phrases = Phrases::default();
            let steps = record.steps.iter().enumerate().map(|(index, one)| {
                let terms = terms.get(index).and_then(Option::as_ref);
                step(one, terms.map_or(&[][..], Vec::as_slice), readers, &mut phrases)
            });
            let steps: Vec<Step> = steps.collect::<anyhow::Result<_>>()?;
            Ok(Self { id: record.identity.id(), phrases: phrases.list, no_terms, steps })
        };
        explain().with_context(|| format!("episode {}", record.identity.id()))
    }
}

/// `terms`: one row for each well-formed candidate, or none at all.
fn step(
    step: &StepRecord,
    terms: &[Vec<f32>],
    readers: &Readers<'_>,
    phrases: &mut Phrases,
) -> anyhow::Result<Step> {
    let decision = step.decision.as_ref();
    let candidates = decision.map_or(&[][..], |decision| &decision.candidates);
    let mut rows = terms.iter();
    let candidates = candidates.iter().map(|one| {
        let row = one.actions.as_ref().and_then(|_| rows.next());
        candidate(one, row.map(|row| largest(row)), readers, phrases)
    });
    let statistics = &step.statistics;
    let flags = [
        statistics.is_grasped,
        statistics.ever_grasped,
        statistics.consecutive_grasp,
        statistics.moved_correct_object,
        statistics.moved_wrong_object,
        statistics.source_on_target,
        statistics.is_success,
        statistics.ever_success,
        statistics.released_success,
    ];
    Ok(Step {
        chosen: decision.and_then(|decision| decision.chosen),
        flags: flags.iter().rev().fold(0, |bits, flag| bits << 1 | u16::from(*flag)),
        decision_ms: decision.map(DecisionRecord::milliseconds),
        candidates: candidates.collect::<anyhow::Result<_>>()?,
    })
}

/// The largest terms first, in percentage points, and the sum of the others.
fn largest(row: &[f32]) -> (Vec<(usize, f64)>, f64) {
    let mut terms: Vec<(usize, f32)> = row.iter().copied().enumerate().collect();
    terms.sort_by(|a, b| b.1.abs().total_cmp(&a.1.abs()));
    let others: f32 = terms.iter().skip(TERMS_LISTED).map(|(_, value)| value).sum();
    let listed = terms.into_iter().take(TERMS_LISTED).filter(|(_, value)| *value != 0.0);
    let listed = listed.map(|(index, value)| (index, rounded(100.0 * value, 3))).collect();
    (listed, rounded(100.0 * others, 3))
}

fn candidate(
    record: &CandidateRecord,
    terms: Option<(Vec<(usize, f64)>, f64)>,
    readers: &Readers<'_>,
    phrases: &mut Phrases,
) -> anyhow::Result<Candidate> {
    // A policy that gives no tokens has no text.
    let mut speech = match record.tokens.is_empty() {
        true => super::Speech { text: String::new(), reasoning: Some(Reasoning::default()) },
        false => (readers.speak)(&record.tokens),
    };
    if let Some(reading) = &record.reading {
        speech.reasoning = Some(reading.reasoning.clone());
    }
    let score = record.score.map(|score| rounded(score, 8));
    let log = rounded(record.log_probability, 2);
    let Some(actions) = &record.actions else {
        let reason = record.malformed.clone().context("a malformed candidate has a reason")?;
        let malformed = phrases.number(reason);
        return Ok(Candidate::Malformed {
            score,
            log,
            malformed,
            text: phrases.number(speech.text),
        });
    };
    let reasoning = speech.reasoning.with_context(|| {
        format!("a recorded well-formed candidate does not parse with this policy: {}", speech.text)
    })?;
    let boxes = reasoning.visible_objects.into_iter().map(|object| {
        let [left, top, right, bottom] = object.bounding_box;
        (phrases.number(object.name), left, top, right, bottom)
    });
    let boxes = boxes.collect();
    let says = [
        reasoning.task,
        reasoning.plan,
        reasoning.subtask_reasoning,
        reasoning.subtask,
        reasoning.move_reasoning,
        reasoning.movement,
    ];
    Ok(Candidate::Reading {
        score,
        log,
        terms,
        actions: actions.actions().iter().map(numbers).collect(),
        says: says.map(|phrase| phrases.number(phrase)),
        boxes,
        gripper: reasoning.gripper_position,
        unread: record.unread.iter().map(|reason| phrases.number(reason.clone())).collect(),
    })
}

fn numbers(action: &Action) -> Vec<f64> {
    action.iter().map(|value| rounded(*value, 5)).collect()
}

fn rounded(value: f32, digits: i32) -> f64 {
    let scale = 10f64.powi(digits);
    (f64::from(value) * scale).round() / scale
}
