//! Lost, slow and wrong servers are faults with their own words.

use std::sync::Arc;
use std::time::Instant;

use tokio_tungstenite::tungstenite::Message;

use super::scripted::{Script, Scripted, frame, metadata, result};
use super::{connect, episode, motions, propose, words};
use crate::codec::{FRAME_BYTES_MAX, Value};

fn fault(script: Script) -> String {
    let server = Scripted::start(0, metadata(), script);
    let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
    let refusal = words(propose(&policy, &episode(), 1, 0));
    let place = format!("openpi://{}: ", server.place);
    refusal.strip_prefix(&place).unwrap_or_else(|| panic!("{refusal}")).to_owned()
}

#[test]
fn wrong_answers_are_named() {
    let traceback = "Traceback (most recent call last):\n  File \"a.py\"\nKeyError: 'prompt'\n";
    let says: Script = Arc::new(move |_, _| Some(vec![Message::Text(traceback.into())]));
    assert_eq!(fault(says), "the server failed: KeyError: 'prompt'");
    assert_eq!(fault(Arc::new(|_, _| None)), "the server closed the connection");
    let binary = |bytes: Vec<u8>| -> Script {
        Arc::new(move |_, _| Some(vec![Message::Binary(bytes.clone().into())]))
    };
    assert_eq!(fault(binary(vec![0x90])), "openpi frame: expected a map, got a list");
    assert_eq!(fault(binary(vec![0xc1])), "frame: expected no extension type, got Reserved");
    let huge = fault(binary(vec![0; FRAME_BYTES_MAX + 1]));
    assert_eq!(huge, "the server sent a frame of more than 33554432 bytes");
    let short = Arc::new(|_: usize, _: &[u8]| {
        let actions = Value::List(vec![Value::Float(0.5); 6]);
        Some(vec![frame(&Value::map([("actions", actions)]))])
    });
    let server = Scripted::start(0, metadata(), short);
    let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
    let refusal = words(propose(&policy, &episode(), 1, 0));
    assert!(refusal.ends_with("actions: expected 7 dimensions, got 6"), "{refusal}");
}

#[test]
fn a_frame_that_nothing_asked_for_is_a_fault() {
    let server =
        Scripted::start(0, metadata(), Arc::new(|_, _| Some(vec![result(0.0), result(1.0)])));
    let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
    let running = episode();
    propose(&policy, &running, 1, 0).expect("the first answer");
    // Whether the second frame is read before or after the next question, it is never an answer to a
    // later one: each question brings two more.
    let refusal = (1..50).map(|seed| propose(&policy, &running, 1, seed)).find_map(Result::err);
    let refusal = format!("{:#}", refusal.expect("a fault"));
    assert!(refusal.contains("a frame that nothing asked for"), "{refusal}");
}

#[test]
fn a_slow_server_is_a_fault_and_the_next_episode_has_a_new_connection() {
    let folder = tempfile::tempdir().expect("a folder");
    let profile = folder.path().join("patient.toml");
    let text = include_str!("../../../profiles/bridge.toml");
    let text = text.replace("[camera]", "[server]\nanswer_secs_max = 1\n\n[camera]");
    std::fs::write(&profile, text).expect("written");
    let script: Script =
        Arc::new(|index, _| Some(if index == 1 { Vec::new() } else { vec![result(0.5)] }));
    let server = Scripted::start(0, metadata(), script);
    let address = format!("openpi://{}", server.place);
    let policy = connect(&address, profile.to_str()).expect("a policy");
    let refusal = words(propose(&policy, &episode(), 1, 0));
    assert!(refusal.ends_with("no answer within 1 s"), "{refusal}");
    assert_eq!(motions(&propose(&policy, &episode(), 1, 0).expect("a proposal")), [0.5]);
}

#[test]
fn a_server_that_is_started_again_serves_the_next_episode_and_another_one_does_not() {
    let script: Script = Arc::new(|_, _| Some(vec![result(0.5)]));
    let server = Scripted::start(0, metadata(), Arc::clone(&script));
    let port = server.place.port();
    let policy = connect(&format!("openpi://{}", server.place), None).expect("a policy");
    let running = episode();
    propose(&policy, &running, 1, 0).expect("a proposal");
    drop(server);
    let lost = words(propose(&policy, &running, 1, 1));
    assert!(lost.contains("connection"), "{lost}");
    let begun = Instant::now();
    let again = std::thread::spawn(move || {
        // The first attempts of the client find nobody.
        while begun.elapsed().as_millis() < 1500 {
            std::thread::yield_now();
        }
        Scripted::start(port, metadata(), script)
    });
    propose(&policy, &episode(), 1, 0).expect("the server came back");
    drop(again.join().expect("started"));
    let other = vec![frame(&Value::map([("policy", Value::text("another"))]))];
    let _other = Scripted::start(port, other, Arc::new(|_, _| Some(vec![result(0.5)])));
    let refusal = words(propose(&policy, &episode(), 1, 0));
    assert!(refusal.ends_with("its metadata has changed during the run"), "{refusal}");
}

#[test]
fn nobody_at_the_address_is_said_at_once() {
    let begun = Instant::now();
    for wire in ["openpi", "vla-eval"] {
        // Port 1 is reserved and unused.
        let refusal = words(connect(&format!("{wire}://127.0.0.1:1"), None));
        assert!(
            refusal.starts_with(&format!("policy server {wire}://127.0.0.1:1: cannot connect")),
            "{refusal}"
        );
    }
    assert!(begun.elapsed().as_secs() < 10);
}
