//! Watches the first decisions of a run: a policy without any well-formed candidate in all of them
//! is read in a wrong way, and more decisions would only hold the robot still.

use std::sync::{Mutex, PoisonError};

use decision::{Candidate, Policy};
use thiserror::Error;

/// Number of decisions from the start of a run after which a policy that never had a well-formed
/// candidate is stopped.
pub const DECISIONS_MAX: usize = 20;
/// Maximum characters of the text that is shown.
const TEXT_CHARACTERS_MAX: usize = 300;

/// The policy had no well-formed candidate in its first [`DECISIONS_MAX`] decisions.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error(
    "policy: expected a well-formed candidate in the first {DECISIONS_MAX} decisions, got none; {first}; check how the \
     checkpoint is read (--reasoning, --prompt, --max-new-tokens) with `rever doctor`"
)]
pub struct NeverWellFormed {
    /// The reason and the text of the first candidate.
    first: String,
}

/// What the decisions of a run have shown so far.
pub struct FirstDecisions {
    state: Mutex<State>,
}

enum State {
    /// No candidate was well formed.
    Unproven { decisions: usize, first: Option<String> },
    /// One was, or none has to be.
    Proven,
}

impl FirstDecisions {
    /// The state at the start of a run. If it needs no well-formed candidate, no decision is an error.
    pub fn new(needs_well_formed: bool) -> FirstDecisions {
        let state = match needs_well_formed {
            true => State::Unproven { decisions: 0, first: None },
            false => State::Proven,
        };
        FirstDecisions { state: Mutex::new(state) }
    }

    /// Notes one decision. Returns an error once too many decisions had no well-formed candidate.
    pub fn note(
        &self,
        candidates: &[Candidate],
        policy: &dyn Policy,
    ) -> Result<(), NeverWellFormed> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let State::Unproven { decisions, first } = &mut *state else { return Ok(()) };
        if candidates.iter().any(|candidate| candidate.parsed.is_ok()) {
            *state = State::Proven;
            return Ok(());
        }
        *decisions += 1;
        if first.is_none() {
            *first = candidates.first().map(|candidate| first_malformed(candidate, policy));
        }
        if *decisions < DECISIONS_MAX {
            return Ok(());
        }
        Err(NeverWellFormed { first: first.clone().unwrap_or_default() })
    }
}

/// Why a candidate is malformed, and its text if the policy has one.
pub fn first_malformed(candidate: &Candidate, policy: &dyn Policy) -> String {
    let reason = match &candidate.parsed {
        Ok(_) => "well formed".to_owned(),
        Err(malformed) => malformed.to_string(),
    };
    let Some(text) = policy.text(candidate) else { return format!("first candidate: {reason}") };
    let short: String = text.chars().take(TEXT_CHARACTERS_MAX).collect();
    let dots = if short.len() < text.len() { "…" } else { "" };
    format!("first candidate: {reason}; its text: {short:?}{dots}")
}

#[cfg(test)]
mod tests {
    use decision::scripted::{ScriptedPolicy, candidate};

    use super::*;

    #[test]
    fn a_policy_that_is_never_well_formed_is_stopped_after_its_first_decisions() {
        let (policy, malformed) = (ScriptedPolicy::new(), candidate(None).expect("a candidate"));
        let first = FirstDecisions::new(true);
        for _ in 1..DECISIONS_MAX {
            first.note(std::slice::from_ref(&malformed), &policy).expect("not yet");
        }
        let error = first.note(&[malformed], &policy).expect_err("that was enough").to_string();
        let expected = "in the first 20 decisions, got none; first candidate: expected an action";
        assert!(error.contains(expected), "{error}");
    }

    #[test]
    fn one_well_formed_candidate_is_enough() {
        let policy = ScriptedPolicy::new();
        let [malformed, formed] = [None, Some(0.5)].map(|x| candidate(x).expect("a candidate"));
        let first = FirstDecisions::new(true);
        first.note(&[malformed.clone(), formed], &policy).expect("well formed");
        for _ in 0..2 * DECISIONS_MAX {
            first.note(std::slice::from_ref(&malformed), &policy).expect("it can be well formed");
        }
    }

    #[test]
    fn a_run_that_needs_no_well_formed_candidate_is_never_stopped() {
        let (policy, malformed) = (ScriptedPolicy::new(), candidate(None).expect("a candidate"));
        let first = FirstDecisions::new(false);
        for _ in 0..2 * DECISIONS_MAX {
            first.note(std::slice::from_ref(&malformed), &policy).expect("none is needed");
        }
    }
}
