//! What a client gets of a decision: the actions, and in optional fields the candidates.

use anyhow::Result;
use decision::{Action, Candidate, Decision, Reasoning, TAGS, probability};

use super::agent::ServedAgent;
use crate::codec::extension::{Answer, AnswerCandidate};

/// The actions to execute, in the server's convention.
pub(super) fn actions(agent: &ServedAgent, decision: &Decision) -> Vec<Action> {
    let form = agent.options.form;
    decision.actions.actions().iter().map(|action| form.convert(action)).collect()
}

/// The optional fields. Tokens and hidden states are sent only to clients that ask for candidates.
pub(super) fn answer(agent: &ServedAgent, decision: &Decision, is_whole: bool) -> Result<Answer> {
    let candidates = decision.candidates.iter().enumerate().map(|(index, candidate)| {
        let logit = decision.logits.as_ref().map(|logits| logits[index]);
        answer_candidate(agent, candidate, logit, is_whole)
    });
    Ok(Answer {
        chosen: decision.chosen,
        candidates: candidates.collect(),
        digest: Some(agent.info().digest.clone()),
    })
}

fn answer_candidate(
    agent: &ServedAgent,
    candidate: &Candidate,
    logit: Option<f32>,
    is_whole: bool,
) -> AnswerCandidate {
    let form = agent.options.form;
    let mut answer = match &candidate.parsed {
        Ok(parsed) => AnswerCandidate {
            actions: parsed.actions.actions().iter().map(|action| form.convert(action)).collect(),
            reasoning: text_of(&parsed.reasoning),
            // A malformed candidate has no action, so it has no success probability.
            score: logit.map(probability),
            action_tokens: if is_whole { parsed.action_tokens.clone() } else { Vec::new() },
            ..AnswerCandidate::default()
        },
        Err(malformed) => {
            AnswerCandidate { malformed: Some(malformed.to_string()), ..AnswerCandidate::default() }
        }
    };
    if is_whole {
        answer.tokens.clone_from(&candidate.tokens);
        answer.log_probability = Some(candidate.log_probability);
        answer.log_probabilities.clone_from(&candidate.log_probabilities);
        answer.confidence.clone_from(&candidate.confidence);
        answer.hidden.clone_from(&candidate.hidden);
    }
    answer
}

/// A reasoning as text that its parser reads back; none for a policy that acts without. Sections that
/// were not read are left out.
fn text_of(reasoning: &Reasoning) -> Option<String> {
    if *reasoning == Reasoning::default() {
        return None;
    }
    let objects = reasoning.visible_objects.iter().map(|object| {
        let [left, top, right, bottom] = object.bounding_box;
        format!("{} [{left}, {top}, {right}, {bottom}]", object.name)
    });
    let positions = reasoning.gripper_position.iter().flatten().map(u16::to_string);
    let sections = [
        reasoning.task.clone(),
        reasoning.plan.clone(),
        objects.collect::<Vec<_>>().join(", "),
        reasoning.subtask_reasoning.clone(),
        reasoning.subtask.clone(),
        reasoning.move_reasoning.clone(),
        reasoning.movement.clone(),
        match reasoning.gripper_position.is_empty() {
            true => String::new(),
            false => format!("[{}]", positions.collect::<Vec<_>>().join(", ")),
        },
    ];
    let mut text = String::new();
    for (tag, section) in TAGS.iter().zip(&sections).filter(|(_, section)| !section.is_empty()) {
        text.push_str(&format!("{tag} {section} "));
    }
    text.push_str(TAGS[TAGS.len() - 1]);
    Some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reasoning_is_read_back_from_its_text() {
        let text = "TASK: put the spoon on the towel PLAN: reach. grasp VISIBLE OBJECTS: spoon [1, 2, 3, 4], towel [5, 6, \
                    7, 8] SUBTASK REASONING: it is far SUBTASK: reach the spoon MOVE REASONING: it is left MOVE: left \
                    GRIPPER POSITION: [10, 20, 30, 40] ACTION:";
        let reasoning = Reasoning::parse(text).expect("a reasoning");
        assert_eq!(text_of(&reasoning).as_deref(), Some(text));
        assert_eq!(text_of(&Reasoning::default()), None);
    }
}
