//! vla-eval: hello, episodes, one session per candidate.

use std::sync::Arc;

use decision::Policy;

use super::scripted::{Scripted, chunk, message};
use super::{connect, episode, motions, propose, words};
use crate::codec::extension::Announcement;
use crate::codec::vla_eval::{self, Kind, Message};
use crate::codec::{Array, Value};
use tokio_tungstenite::tungstenite::Message as Sent;

fn hello(sequence: u64, capabilities: Value<'static>) -> Sent {
    let payload = Value::map([
        ("harness_version", Value::text("0.8.0")),
        ("protocol_version", Value::Integer(1)),
        ("model_server", Value::text("Scripted")),
        ("capabilities", capabilities),
    ]);
    message(Kind::Hello, payload, sequence)
}

/// Answers every observation with the number of its connection.
fn server(answer: impl Fn(usize, u64) -> Sent + Send + Sync + 'static) -> Scripted {
    Scripted::start(
        0,
        Vec::new(),
        Arc::new(move |index, frame| {
            let received = Message::decode(frame).expect("a message");
            Some(match received.kind {
                Kind::Hello => vec![hello(received.sequence, Value::map([]))],
                Kind::Observation => vec![answer(index, received.sequence)],
                _ => Vec::new(),
            })
        }),
    )
}

fn action(x: f32, sequence: u64) -> Sent {
    let array: Array<'static> = chunk(x);
    message(Kind::Action, Value::map([("actions", array.into_value(vla_eval::KEYS))]), sequence)
}

#[test]
fn every_candidate_has_a_session_that_sees_every_observation_once() {
    let server = server(|index, sequence| action(index as f32, sequence));
    let policy = connect(&format!("vla-eval://{}", server.place), None).expect("a policy");
    assert_eq!(policy.profile_name(), "simpler");
    let running = episode();
    for seed in 0..2 {
        let mut moved = motions(&propose(&policy, &running, 3, seed).expect("a proposal"));
        moved.sort_by(f32::total_cmp);
        assert_eq!(moved, [1.0, 2.0, 3.0], "one answer of each session");
    }
    drop(running);
    let kinds = |index: usize| -> Vec<Kind> {
        let received = server.received.lock().expect("not poisoned");
        let own = received.iter().filter(|(connection, _)| *connection == index);
        own.map(|(_, frame)| Message::decode(frame).expect("a message").kind).collect()
    };
    let expected =
        [Kind::Hello, Kind::EpisodeStart, Kind::Observation, Kind::Observation, Kind::EpisodeEnd];
    // The end of an episode is noticed within half a second.
    let deadline = std::time::Instant::now() + std::time::Duration::from_secs(60);
    while (1..4).any(|index| kinds(index).len() < expected.len()) {
        assert!(std::time::Instant::now() < deadline, "no end: {:?}", kinds(1));
        std::thread::yield_now();
    }
    (1..4).for_each(|index| assert_eq!(kinds(index), expected));
    let received = server.received.lock().expect("not poisoned");
    let start = received.iter().map(|(_, frame)| Message::decode(frame).expect("a message"));
    let mut starts = start.filter(|message| message.kind == Kind::EpisodeStart);
    let task = starts.next().expect("a start").payload;
    let task = task.field("task").expect("a task").clone();
    assert_eq!(
        task.field("name").and_then(|name| name.as_text()).expect("a name"),
        "widowx_stack_cube"
    );
    assert_eq!(
        task.field("episode_idx").and_then(|index| index.as_integer::<u32>()).expect("a number"),
        3
    );
}

#[test]
fn wrong_answers_are_faults_in_words() {
    let check = |answer: fn(u64) -> Sent, expected: &str| {
        let server = server(move |_, sequence| answer(sequence));
        let policy = connect(&format!("vla-eval://{}", server.place), None).expect("a policy");
        let running = episode();
        let refusal = words(propose(&policy, &running, 1, 0));
        assert!(refusal.ends_with(expected), "{refusal}");
        assert_eq!(words(propose(&policy, &running, 1, 0)), refusal, "the episode is void");
    };
    check(
        |sequence| action(0.0, sequence - 1),
        "expected the answer to message 3, got the answer to message 2",
    );
    check(
        |sequence| {
            message(
                Kind::Error,
                Value::map([("error", Value::text("KeyError: 'states'"))]),
                sequence,
            )
        },
        "the server failed: KeyError: 'states'",
    );
    check(|sequence| hello(sequence, Value::map([])), "expected a message action, got hello");
    check(
        |sequence| message(Kind::Action, Value::map([]), sequence),
        "expected the key \"actions\", got an empty map",
    );
}

#[test]
fn a_server_of_another_kind_or_version_is_refused_at_the_start() {
    let announcement = Announcement { candidates_max: 4, ..Announcement::default() };
    let fields = announcement.value(vla_eval::KEYS).expect("encodes");
    let announcing = Scripted::start(
        0,
        Vec::new(),
        Arc::new(move |_, frame| {
            let sequence = Message::decode(frame).expect("a message").sequence;
            Some(vec![hello(sequence, Value::map([("rever", fields.clone())]))])
        }),
    );
    let policy = connect(&format!("vla-eval://{}", announcing.place), None).expect("a policy");
    assert_eq!(policy.announcement().map(|announced| announced.candidates_max), Some(4));
    assert!(policy.info().hidden_size.is_none());
    let newer = Scripted::start(
        0,
        Vec::new(),
        Arc::new(|_, frame| {
            let sequence = Message::decode(frame).expect("a message").sequence;
            let payload = Value::map([("protocol_version", Value::Integer(2))]);
            Some(vec![message(Kind::Hello, payload, sequence)])
        }),
    );
    let refusal = words(connect(&format!("vla-eval://{}", newer.place), None));
    assert!(refusal.ends_with("vla-eval: expected protocol version 1, got 2"), "{refusal}");
}
