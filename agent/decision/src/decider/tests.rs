//! Tests of the decider with scripted policies and scorers.

use std::sync::Arc;

use protocol::Dimension;

use super::*;
use crate::scripted::{Answer, ScriptedPolicy, ScriptedScorer};
use crate::{Setting, Strategy};

fn dimensions() -> Vec<Dimension> {
    let names = ["x", "y", "z", "rotation_x", "rotation_y", "rotation_z", "gripper"];
    let dimension =
        |name: &str| Dimension { name: name.to_owned(), low: None, high: None, discrete: false };
    names.map(dimension).to_vec()
}

fn context(
    strategy: Strategy,
    instruction: &str,
    scorer: Option<Arc<dyn Scorer>>,
) -> EpisodeContext {
    let setting = Setting { strategy, candidates: 3, temperature: 1.0 };
    EpisodeContext::new(setting, 7, instruction, scorer, &dimensions())
}

async fn decide(
    policy: Arc<ScriptedPolicy>,
    contexts: &mut [EpisodeContext],
) -> Vec<Result<Decision, DecisionFault>> {
    let observation = Observation {
        image: Default::default(),
        state: vec![0.0; 8],
        instruction: String::new(),
        expert_action: None,
    };
    let requests = contexts
        .iter_mut()
        .map(|context| DecisionRequest { observation: &observation, context })
        .collect();
    Decider::new(policy).decide(requests).await
}

fn motions(motions: &[Option<f32>]) -> Answer {
    Answer::Motions(motions.to_vec())
}

#[tokio::test]
async fn the_scorer_ranks_and_the_chosen_candidate_is_executed() {
    let policy = ScriptedPolicy::new().with("go", [motions(&[Some(0.1), None, Some(0.3)])]);
    let scorer: Arc<dyn Scorer> = Arc::new(ScriptedScorer::new("far", 1.0));
    let mut contexts = [
        context(Strategy::Verifier, "go", Some(Arc::clone(&scorer))),
        context(Strategy::Worst, "go", Some(scorer)),
        context(Strategy::FirstWellFormed, "go", None),
    ];
    let decisions = decide(Arc::new(policy), &mut contexts).await;
    let chosen: Vec<_> = decisions
        .iter()
        .map(|decision| decision.as_ref().map(|one| (one.chosen, one.actions.first()[0])))
        .collect();
    assert_eq!(chosen, [Ok((Some(2), 0.3)), Ok((Some(0), 0.1)), Ok((Some(0), 0.1))]);
    assert!(decisions[2].as_ref().is_ok_and(|decision| decision.logits.is_none()));
}

#[tokio::test]
async fn a_robot_without_a_well_formed_candidate_holds_still_with_its_last_gripper_command() {
    let policy = Arc::new(
        ScriptedPolicy::new()
            .with("go", [motions(&[None]), motions(&[Some(0.2)]), motions(&[None])]),
    );
    let mut contexts = [context(Strategy::Medoid, "go", None)];
    let mut actions = Vec::new();
    for _ in 0..3 {
        let decision = decide(Arc::clone(&policy), &mut contexts).await.remove(0);
        let decision = decision.expect("a decision");
        actions.push((decision.chosen, decision.actions.first().to_vec()));
    }
    let held = |gripper: f32| vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.0, gripper];
    assert_eq!(actions[0], (None, held(1.0)), "episodes begin with an open gripper");
    assert_eq!(actions[1].0, Some(0));
    assert_eq!(actions[2], (None, held(-1.0)), "the candidate before closed it");
    assert_eq!(contexts[0].step, 3);
}

#[tokio::test]
async fn a_request_that_the_policy_fails_on_does_not_affect_the_others() {
    let policy = ScriptedPolicy::new()
        .with("bad", [Answer::Fails("logits are not finite".to_owned())])
        .with("good", [motions(&[Some(0.5)])]);
    let policy = Arc::new(policy);
    let mut contexts = [
        context(Strategy::Sample, "good", None),
        context(Strategy::Sample, "bad", None),
        context(Strategy::Sample, "good", None),
    ];
    let decisions = decide(Arc::clone(&policy), &mut contexts).await;
    assert!(decisions[0].is_ok() && decisions[2].is_ok());
    let reason = "logits are not finite".to_owned();
    assert_eq!(decisions[1], Err(DecisionFault::Policy { reason }));
    assert_eq!(policy.batches(), [3, 1, 1, 1]);
}

#[tokio::test]
async fn a_scorer_that_fails_is_a_fault_of_its_episode_alone() {
    let policy = Arc::new(ScriptedPolicy::new());
    let scorer: Arc<dyn Scorer> = Arc::new(ScriptedScorer::new("far", 1.0).failing_for("unlucky"));
    let mut contexts = [
        context(Strategy::Verifier, "lucky", Some(Arc::clone(&scorer))),
        context(Strategy::Verifier, "unlucky", Some(Arc::clone(&scorer))),
    ];
    let decisions = decide(policy, &mut contexts).await;
    assert!(decisions[0].is_ok());
    let reason = "the scripted scorer fails".to_owned();
    assert_eq!(decisions[1], Err(DecisionFault::Scorer { reason }));
}

#[tokio::test]
async fn a_score_that_is_not_finite_is_a_fault() {
    let policy = ScriptedPolicy::new().with("go", [motions(&[Some(f32::MAX)])]);
    let scorer: Arc<dyn Scorer> = Arc::new(ScriptedScorer::new("overflow", f32::MAX));
    let mut contexts = [context(Strategy::Verifier, "go", Some(scorer))];
    let decision = decide(Arc::new(policy), &mut contexts).await.remove(0);
    let reason = "expected a finite score of candidate 0, got inf".to_owned();
    assert_eq!(decision, Err(DecisionFault::Scorer { reason }));
}

#[tokio::test]
async fn a_decision_does_not_depend_on_the_other_episodes_of_the_batch() {
    let policy =
        || Arc::new(ScriptedPolicy::new().with("go", [motions(&[Some(0.1), Some(0.4), None])]));
    let scorer: Arc<dyn Scorer> = Arc::new(ScriptedScorer::new("far", 1.0));
    let make = || context(Strategy::Verifier, "go", Some(Arc::clone(&scorer)));
    let alone = decide(policy(), &mut [make()]).await.remove(0);
    let other = context(Strategy::Greedy, "other", None);
    let together = decide(policy(), &mut [other, make()]).await.remove(1);
    let (alone, together) = (alone.expect("a decision"), together.expect("a decision"));
    assert_eq!((alone.chosen, alone.actions), (together.chosen, together.actions));
    assert_eq!(alone.candidates, together.candidates);
}
