//! openpi: chunks, candidates, optional fields.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use decision::{Image, Policy, Setting, Strategy};

use super::super::episodes::Episodes;
use super::scripted::{Script, Scripted, frame, metadata, result, result_with};
use super::{connect, episode, image, motions, propose, propose_seeing, words};
use crate::codec::extension::{Announcement, Answer, AnswerCandidate, Ask};
use crate::codec::{Array, Value, decode, openpi};

/// A server whose every answer moves by another x.
fn sampling() -> Scripted {
    let count = AtomicU32::new(0);
    Scripted::start(
        0,
        metadata(),
        Arc::new(move |_, _| Some(vec![result(count.fetch_add(1, Ordering::Relaxed) as f32)])),
    )
}

#[test]
fn candidates_are_asked_one_by_one_and_their_chunks_are_executed_in_part() {
    let server = sampling();
    let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
    let proposal = propose(&policy, &episode(), 5, 1).expect("a proposal");
    let mut moved = motions(&proposal);
    moved.sort_by(f32::total_cmp);
    assert_eq!(moved, [0.0, 1.0, 2.0, 3.0, 4.0]);
    let actions = proposal.candidates[0].action().expect("well formed").actions;
    assert_eq!(actions.actions().len(), 2, "fewer than the profile's four");
    assert_eq!(actions.first()[6], 1.0);
    assert!(proposal.candidates.iter().all(|one| one.hidden.is_empty() && one.tokens.is_empty()));
    assert_eq!(policy.info().image_size, (224, 224));
    let received = server.received.lock().expect("not poisoned");
    let observation = decode(&received[0].1).expect("a map");
    let keys: Vec<&str> =
        observation.entries().expect("a map").iter().map(|(key, _)| &*key.name).collect();
    let expected = ["observation/image", "observation/wrist_image", "observation/state", "prompt"];
    assert_eq!(keys, expected);
    let state = Array::from_value(observation.field("observation/state").expect("a key"));
    assert_eq!(state.expect("an array").to_f32(), [0.25, 0.5, 0.75, 0.0, 0.0, 0.0, 1.0]);
}

#[test]
fn an_episode_has_its_own_connections_until_it_ends() {
    let server = sampling();
    let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
    let (one, other) = (episode(), episode());
    for seed in 0..3 {
        propose(&policy, &one, 1, seed).expect("a proposal");
        propose(&policy, &other, 1, seed).expect("a proposal");
    }
    let received = server.received.lock().expect("not poisoned").clone();
    let indices: Vec<usize> = received.iter().map(|(index, _)| *index).collect();
    assert_eq!(indices, [1, 2, 1, 2, 1, 2], "the first connection only greeted");
    // The same decision again does not reach the server.
    propose(&policy, &one, 1, 2).expect("a proposal");
    assert_eq!(server.received.lock().expect("not poisoned").len(), received.len());
    // Another observation does, even with the same seed.
    let other = Image { pixels: vec![9; 224 * 224 * 3].into(), ..image() };
    propose_seeing(&other, &policy, &one, (1, 2)).expect("a proposal");
    assert_eq!(server.received.lock().expect("not poisoned").len(), received.len() + 1);
}

#[test]
fn a_session_ends_with_its_episode() {
    let episodes = Episodes::default();
    let (one, other) = (episode(), episode());
    let session = episodes.session(Some(&one));
    assert!(Arc::ptr_eq(&session, &episodes.session(Some(&one))));
    assert!(!Arc::ptr_eq(&session, &episodes.session(Some(&other))));
    drop(one);
    let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
    runtime.block_on(episodes.end_finished());
    assert_eq!(Arc::strong_count(&session), 1, "only this test holds it");
}

#[test]
fn the_time_of_sending_is_no_part_of_the_metadata() {
    let sent = |seconds: f64| {
        let metadata = [("model", Value::text("a")), ("timestamp", Value::Float(seconds))];
        let script: Script = Arc::new(|_, _| Some(vec![result(0.5)]));
        let server = Scripted::start(0, vec![frame(&Value::map(metadata))], script);
        let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
        policy.info().digest.clone()
    };
    assert_eq!(sent(1.0), sent(2.0));
}

fn announcing(announcement: &Announcement, answer: Answer) -> Scripted {
    let fields = announcement.value(openpi::KEYS).expect("encodes");
    let greeting = vec![frame(&Value::map([("rever", fields)]))];
    Scripted::start(0, greeting, Arc::new(move |_, _| Some(vec![result_with(&answer)])))
}

fn announcement() -> Announcement {
    Announcement {
        candidates_max: 5,
        digest: Some("477a".to_owned()),
        is_greedy: true,
        image_size: Some((224, 224)),
        hidden_size: Some(2),
        confidence_size: Some(16),
        action_scale: Some(vec![0.5; 7]),
    }
}

#[test]
fn announced_fields_make_whole_candidates_in_one_request() {
    let candidate = |x: f32| AnswerCandidate {
        actions: vec![vec![x, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]],
        reasoning: Some("TASK: stack".to_owned()),
        tokens: vec![5, 6],
        action_tokens: vec![9; 7],
        log_probabilities: vec![-1.0, -0.5],
        confidence: vec![-0.25; 16],
        hidden: vec![x, 1.0],
        ..AnswerCandidate::default()
    };
    let answer = Answer {
        chosen: Some(1),
        candidates: vec![candidate(0.1), candidate(0.2)],
        digest: Some("477a".to_owned()),
    };
    let server = announcing(&announcement(), answer);
    let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
    assert_eq!(policy.profile_name(), "rever");
    assert_eq!((policy.info().digest.as_str(), policy.info().hidden_size), ("477a", Some(2)));
    assert_eq!(policy.info().action_space.scale, [0.5; 7]);
    let proposal = propose(&policy, &episode(), 2, 77).expect("a proposal");
    assert_eq!(motions(&proposal), [0.1, 0.2]);
    let first = &proposal.candidates[0];
    assert_eq!((first.log_probability, &first.hidden[..]), (-1.5, &[0.1, 1.0][..]));
    let parsed = first.parsed.as_ref().expect("well formed");
    assert_eq!((parsed.reasoning.task.as_str(), parsed.action_tokens.len()), ("stack", 7));
    let received = server.received.lock().expect("not poisoned");
    let ask = Ask::read(&decode(&received[0].1).expect("a map")).expect("fields").expect("fields");
    assert_eq!((ask.candidates, ask.temperature, ask.seed), (Some(2), Some(1.0), Some(77)));
    assert!(ask.episode.expect("a name").starts_with("widowx_stack_cube/3/"));
    for (strategy, count) in [(Strategy::Verifier, 5), (Strategy::Greedy, 1)] {
        policy.check(&Setting::new(strategy, count, 1.0)).expect("possible");
    }
    let many = words(policy.check(&Setting::new(Strategy::Medoid, 6, 1.0)));
    assert!(many.ends_with("gives at most 5 candidates"), "{many}");
}

#[test]
fn answers_that_break_the_announcement_are_refused() {
    let candidate = AnswerCandidate { actions: vec![vec![0.0; 7]], ..AnswerCandidate::default() };
    let with = |candidates: Vec<AnswerCandidate>, digest: Option<&str>| {
        let digest = digest.map(str::to_owned);
        let server = announcing(&announcement(), Answer { chosen: None, candidates, digest });
        let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
        words(propose(&policy, &episode(), 1, 1))
    };
    let none = with(vec![candidate.clone(); 2], None);
    assert!(none.ends_with("expected 1 candidates, got 2"), "{none}");
    let hidden = with(vec![candidate.clone()], None);
    assert!(hidden.ends_with("candidate 0: hidden: expected 2 numbers, got 0"), "{hidden}");
    let digest = with(vec![candidate], Some("beef"));
    assert!(digest.ends_with("expected the policy 477a, got beef"), "{digest}");
}

#[test]
fn settings_that_a_plain_server_cannot_do_are_refused_in_words() {
    let server = sampling();
    let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
    for (strategy, temperature, expected) in [
        (Strategy::Verifier, 1.0, "expected a policy that exposes hidden states"),
        (Strategy::Greedy, 1.0, "answers = \"greedy\" (now bridge says \"sampled\")"),
        (Strategy::Medoid, 0.7, "takes no temperature; expected --temperature 1"),
    ] {
        let refusal = words(policy.check(&Setting::new(strategy, 5, temperature)));
        assert!(refusal.contains(expected), "{refusal}");
    }
    for strategy in
        [Strategy::Sample, Strategy::FirstWellFormed, Strategy::Majority, Strategy::Medoid]
    {
        policy.check(&Setting::new(strategy, 5, 1.0)).expect("possible");
    }
    assert_eq!(policy.info().hidden_size, None);
    let same = connect(&format!("openpi://{}", server.place), None).expect("a policy");
    assert_eq!(same.info().digest, policy.info().digest);
    let other = connect(&format!("openpi://{}", server.place), Some("libero")).expect("a policy");
    assert_ne!(other.info().digest, policy.info().digest, "another mapping");
}
