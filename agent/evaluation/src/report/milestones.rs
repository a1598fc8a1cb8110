//! What the list shows of an episode's steps: when it grasped, when it succeeded, its mean score, its clearest choice.

use serde::Serialize;

use store::record::{DecisionRecord, EpisodeRecord};

/// Steps count from 0.
#[derive(Default, Serialize)]
pub struct Milestones {
    /// The first step after which the object was held.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grasp: Option<usize>,
    /// The first step after which the task was done.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub success: Option<usize>,
    /// The mean score of the executed candidates.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub score: Option<f64>,
    /// The decision whose executed candidate leads its siblings by most: before the success, and of those in which it
    /// is not the first if there are any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub choice: Option<usize>,
}

impl Milestones {
    pub fn of(record: &EpisodeRecord) -> Milestones {
        let first = |holds: &dyn Fn(&protocol::Statistics) -> bool| {
            record.steps.iter().position(|step| holds(&step.statistics))
        };
        let success = first(&|statistics| statistics.is_success);
        // After the task is done a choice changes little.
        let steps = success.unwrap_or(record.steps.len());
        let leads = record.steps[..steps].iter().enumerate().filter_map(|(index, step)| {
            let decision = step.decision.as_ref()?;
            // The first candidate is the one that a single sample executes: another one is a choice that differs.
            Some((decision.chosen? > 0, lead(decision)?, index))
        });
        let clearest = leads
            .filter(|(_, lead, _)| *lead > 0.0)
            .max_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
        Milestones {
            grasp: first(&|statistics| statistics.is_grasped),
            success,
            score: record.score_mean().map(|score| (f64::from(score) * 1e4).round() / 1e4),
            choice: clearest.map(|(_, _, index)| index),
        }
    }
}

/// How far the logit of the executed candidate is above the best of the others.
fn lead(decision: &DecisionRecord) -> Option<f64> {
    let logit = |score: f32| {
        let score = f64::from(score).clamp(1e-9, 1.0 - 1e-9);
        (score / (1.0 - score)).ln()
    };
    let chosen = decision.chosen? as usize;
    let others = decision.candidates.iter().enumerate().filter(|(index, _)| *index != chosen);
    let others = others.filter(|(_, one)| one.malformed.is_none());
    let best = others.filter_map(|(_, one)| one.score).map(logit).max_by(f64::total_cmp)?;
    Some(logit(decision.candidates.get(chosen)?.score?) - best)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::sample;

    #[test]
    fn the_clearest_choice_has_the_largest_lead_and_is_not_the_first_candidate() {
        let mut record =
            sample::records().into_iter().find(|one| one.identity.candidates == 5).expect("five");
        for step in &mut record.steps {
            for candidate in &mut step.decision.as_mut().expect("a decision").candidates {
                candidate.score = candidate.score.map(|_| 0.5);
            }
        }
        assert_eq!(Milestones::of(&record).choice, None, "all scores are equal");
        for (step, chosen, score) in [(7, 0, 0.9), (11, 0, 0.95), (9, 2, 0.8)] {
            let decision = record.steps[step].decision.as_mut().expect("a decision");
            decision.chosen = Some(chosen);
            let candidate = &mut decision.candidates[chosen as usize];
            (candidate.score, candidate.malformed) = (Some(score), None);
            // The last one leads by less, but it is not what a single sample would have executed.
            assert_eq!(Milestones::of(&record).choice, Some(step));
        }
    }
}
